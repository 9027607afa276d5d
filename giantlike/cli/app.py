"""Table of the commands of ``giantlike``; the module of a command is imported when the command is called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup

from giantlike.cli.outcome import command


@dataclass(frozen=True, slots=True)
class Entry:
    """A command: the function with its arguments, or a group of commands."""

    summary: str  # line in the list of commands
    module: str = ""  # module, function: in ``giantlike.cli``, and its function that returns an exit code; or empty
    function: str = ""
    commands: Mapping[str, Entry] = field(default_factory=dict)  # those of a group


_CAMERA = {
    "info": Entry("Show the model, field of view and pixel scale of a camera file.", "camera_commands", "info"),
    "convert": Entry("Write a camera in another file format or as another model.", "camera_commands", "convert"),
}
_CATALOG = {
    "build": Entry("Make one catalog of published files.", "catalog_commands", "build"),
    "join": Entry("Put catalogs together, such as your own stars on top of the default.", "catalog_commands", "join"),
    "query": Entry("List the stars of a cone, brightest first.", "catalog_commands", "query"),
    "info": Entry("Show the contents and sources of a catalog.", "catalog_commands", "info"),
}
_SHAPE = {
    "info": Entry("Measure shapes and list their defects.", "shape_commands", "info"),
    "convert": Entry("Write a shape in another format, in km.", "shape_commands", "convert"),
    "decimate": Entry("Write a shape with fewer facets.", "shape_commands", "decimate"),
    "render": Entry("Make a picture of a shape.", "shape_picture", "render_shape"),
    "landmarks": Entry("Choose landmarks for surface_features.", "shape_landmarks", "landmarks"),
}
_NETWORK = {
    "adjust": Entry("Adjust points and poses of a control network.", "network_command", "adjust_network"),
    "read": Entry("Show what a control network holds.", "network_command", "read"),
}
_COMMANDS = {
    "init": Entry("Write a commented campaign file for a folder of images.", "check_commands", "init"),
    "check": Entry("Show all mistakes of a campaign file and its files.", "check_commands", "check"),
    "run": Entry("Run a campaign: attitudes from stars, then every estimator.", "run_command", "run"),
    "status": Entry("Show the state of a run, of one at work too.", "status_commands", "status"),
    "compare": Entry("Compare a run with another, or with another team's.", "compare_command", "compare"),
    "merge": Entry("Make one run of runs of parts of a campaign.", "compare_command", "merge"),
    "view": Entry("Look into a run in a browser, and edit it.", "viewer_commands", "view"),
    "show": Entry("Draw an image of a run with what was found in it.", "viewer_commands", "show"),
    "explain": Entry("Say in words how the results of an image came about.", "viewer_commands", "explain"),
    "backplanes": Entry("Write range, angles and coordinates of every pixel.", "viewer_commands", "backplanes"),
    "dossier": Entry("Put together what a verification report of a run needs.", "viewer_commands", "dossier"),
    "edit": Entry("Reject or restore images, stars and fixes of a run.", "status_commands", "edit"),
    "calibrate": Entry("Calibrate a camera from stars or a checkerboard.", "calibrate_command", "calibrate"),
    "stars": Entry("Solve the attitude of star images, without a campaign file.", "stars_command", "stars"),
    "detect": Entry("Find stars and other point sources.", "detect_command", "detect"),
    "plan": Entry("Predict what images will show, and choose which to take.", "plan_command", "plan"),
    "render": Entry("Make images of bodies and stars, with noise and truth.", "campaign_commands", "render"),
    "estimators": Entry("List the estimators of bodies and their options.", "estimators_command", "estimators"),
    "report": Entry("Write report.html of a finished run again.", "report_command", "report"),
    "export": Entry("Write the attitudes of a run for other programs.", "campaign_commands", "export"),
    "photometry": Entry("Measure stars of a run, and the zero point.", "photometry_command", "photometry"),
    "search": Entry("Find what moves in the images of a run.", "search_command", "search"),
    "interlock": Entry("Estimate the rotation between two sensors.", "campaign_commands", "interlock"),
    "demo": Entry("Simulate an approach, run it, and compare with the truth.", "campaign_commands", "demo"),
    "gauntlet": Entry("Put off-nominal images with known truth to every estimator.", "gauntlet_command", "gauntlet"),
    "replay": Entry("Replay a paper on a flight system, its numbers beside ours.", "replay_command", "replay"),
    "network": Entry("Adjust control networks: points and poses from many images.", commands=_NETWORK),
    "shape": Entry("Measure, convert, decimate and draw shape models.", commands=_SHAPE),
    "camera": Entry("Show camera files, and convert from and to other programs.", commands=_CAMERA),
    "catalog": Entry("Build, join, query and show star catalogs.", commands=_CATALOG),
}


class LazyGroup(TyperGroup):
    """Group of commands that imports the module of a command when it is called; subclasses have the table."""

    table: ClassVar[Mapping[str, Entry]]

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        """Names of the commands, in the order of the table."""
        return list(self.table)

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        """Return the command of a name; None if there is none."""
        entry = self.table.get(cmd_name)
        if entry is None:
            return None
        if entry.commands:
            return typer.main.get_group(_group(cmd_name, entry.summary, entry.commands))
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(cmd_name)(command(getattr(import_module(f"giantlike.cli.{entry.module}"), entry.function)))
        return typer.main.get_command(alone)

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.summary) for name, entry in self.table.items()])


def _version(wanted: bool) -> None:
    if wanted:
        from giantlike.core.version import VERSION

        typer.echo(f"giantlike {VERSION}")
        raise typer.Exit


def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def _group(name: str, summary: str, table: Mapping[str, Entry], *, completion: bool = False) -> typer.Typer:
    return typer.Typer(
        name=name,
        cls=type("Group", (LazyGroup,), {"table": table}),
        help=summary,
        no_args_is_help=True,
        add_completion=completion,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog="Exit codes: 0 done, 1 some images or files failed or goals are missed, 2 bad input, 130 interrupted "
        "(129, 143: by the signals HUP, TERM).",
    )


app = _group(
    "giantlike",
    "Ground workbench for optical navigation: spacecraft images in, navigation observables out.",
    _COMMANDS,
    completion=True,
)
app.callback()(_main)
