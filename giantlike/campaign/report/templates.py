"""HTML pages from the templates of this folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from giantlike.plotting.charts import ChartSheet


@dataclass(frozen=True, slots=True)
class PageFigure:
    """A figure of a page."""

    svg: str  # the figure as SVG
    caption: str

    @classmethod
    def from_figure(cls, figure: ChartSheet | Figure, name: str, caption: str) -> PageFigure:
        """Figure of a page from charts or a figure of matplotlib."""
        from giantlike.plotting.charts import ChartSheet, charts_svg
        from giantlike.plotting.style import svg_text

        return cls(charts_svg(figure, name) if isinstance(figure, ChartSheet) else svg_text(figure, name), caption)


def render_page(template: str, package: str = "giantlike.campaign.report", **content: Any) -> str:
    """Fill a template; it may show numbers by ``| sig`` (three significant digits, a dash for None)."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(one, "") for one in (package, "giantlike.campaign.report")]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["sig"] = _significant
    return environment.get_template(template).render(**content)


def _significant(value: float | None, digits: int = 3) -> str:
    if value is None:
        return "–"
    return f"{value:.{digits}g}" if 1e-4 <= abs(value) < 1e6 or value == 0 else f"{value:.{digits - 1}e}"
