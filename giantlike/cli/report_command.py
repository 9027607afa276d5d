"""``giantlike report``: the page of a finished run; a separate module, since it imports a third of the others."""

from __future__ import annotations

from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.store.results import load_result
from giantlike.cli.arguments import Json, Run
from giantlike.cli.outcome import ExitCode, show_result


def report(folder: Run, json: Json = False) -> ExitCode:
    """Rewrite report.html of a finished run."""
    path = write_report(load_result(folder))
    return show_result({"report": path}, f"wrote {path}", json=json)
