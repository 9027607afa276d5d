"""Hashes of the image files of a campaign, to detect those that changed since they were read."""

from __future__ import annotations

from giantlike._system.reading import file_sha256
from giantlike.campaign.file.config import ImageEntry
from giantlike.campaign.store.database import KnownImage
from giantlike.campaign.store.run_folder import RunFolder, stamp_of


class Identities:
    """Hashes of the contents of image files, where known, now and when they were read."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._known = folder.images()
        self._stamps: dict[str, str] = {}
        self._now: dict[str, str] = {}

    def find_hash(self, entry: ImageEntry) -> str:
        """Hash of the content; empty if the file was never read.

        A file that was written again, or copied, is hashed: it may have the content that it had.
        """
        if entry.key not in self._now:
            known = self._known.get(entry.key, KnownImage("", ""))
            stamp = self._stamps[entry.key] = stamp_of(entry.path)
            sha256 = known.sha256
            if sha256 and stamp != known.stamp:
                try:
                    sha256 = file_sha256(entry.path)
                except OSError:
                    sha256 = ""
                if sha256 == known.sha256:
                    self._folder.set_image_state(entry.key, KnownImage(stamp, sha256))
            self._now[entry.key] = sha256
        return self._now[entry.key]

    def read(self, entry: ImageEntry, sha256: str) -> None:
        """Keep the hash of the file that a worker read."""
        self._now[entry.key] = sha256
        self._folder.set_image_state(entry.key, KnownImage(self._stamps.get(entry.key, ""), sha256))
