"""``giantlike estimators``: the estimators of bodies, and their options."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Annotated, Any

import typer

from giantlike.cli.arguments import Json
from giantlike.cli.outcome import ExitCode, print_json
from giantlike.core.arrays import require
from giantlike.relative import ESTIMATORS


def estimators(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Show the options of this one.")] = None,
    json: Json = False,
) -> ExitCode:
    """List the estimators, or show one with its options."""
    require(name is None or name in ESTIMATORS, f"unknown estimator {name!r}; there are {', '.join(ESTIMATORS)}")
    described = [_describe_estimator(one) for one in ESTIMATORS if name in (None, one)]
    if json:
        print_json(described)
    elif name is None:
        width = max(map(len, ESTIMATORS))
        for one in described:
            typer.echo(f"{one['name']:<{width}}  {one['summary']}")
        typer.echo("\ngiantlike estimators NAME shows the options, which go into a campaign file as "
                   "options.NAME = { ... } of a target.")  # fmt: skip
    else:
        typer.echo(f"{described[0]['name']}: {described[0]['description']}\n")
        for option in described[0]["options"]:
            typer.echo(f"  {option['name']} = {option['default']}")
    return ExitCode.DONE


def _describe_estimator(name: str) -> dict[str, Any]:
    estimator = ESTIMATORS[name]()
    text = inspect.cleandoc(type(estimator).__doc__ or "").split("\nParameters\n")[0].rstrip()
    return {
        "name": name,
        "summary": " ".join(text.split("\n\n")[0].split()),
        "description": text,
        "options": _options(estimator.options, ""),
    }


def _options(options: Any, prefix: str) -> list[dict[str, Any]]:
    """Names and defaults of an options dataclass, of nested ones with dots."""
    listed = []
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            listed += _options(value, f"{prefix}{field.name}.")
        else:
            number = isinstance(value, bool | int | None) or (isinstance(value, float) and math.isfinite(value))
            plain = value if number else str(value)
            listed.append({"name": prefix + field.name, "default": plain})
    return listed
