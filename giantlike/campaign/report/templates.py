"""Web pages from the templates of this folder."""

from __future__ import annotations

from typing import Any


def render_page(template: str, **content: Any) -> str:
    """Fill a template; numbers may be shown by ``| sig`` (three significant digits, a dash for none)."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("giantlike.campaign.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["sig"] = _significant
    return environment.get_template(template).render(**content)


def _significant(value: float | None, digits: int = 3) -> str:
    """Text of a number for people; a dash for none."""
    if value is None:
        return "–"
    return f"{value:.{digits}g}" if 1e-4 <= abs(value) < 1e6 or value == 0 else f"{value:.{digits - 1}e}"
