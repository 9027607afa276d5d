"""Pictures of values, ``value.plot()`` and the display in notebooks, by painters that other modules register."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PAINTERS: dict[type[Any], Callable[..., Axes]] = {}
_PROVIDERS: list[str] = []


def provide(module: str) -> None:
    """Name a module that registers painters when it is imported."""
    if module not in _PROVIDERS:
        _PROVIDERS.append(module)


def paints(kind: type[Any]) -> Callable[[Callable[..., Axes]], Callable[..., Axes]]:
    """Decorator for the function that draws values of a class on axes."""

    def register(painter: Callable[..., Axes]) -> Callable[..., Axes]:
        _PAINTERS[kind] = painter
        return painter

    return register


def painter_of(kind: type[Any]) -> Callable[..., Axes]:
    """Return the function that draws values of a class."""
    for module in _PROVIDERS:
        import_module(module)
    for base in kind.__mro__:
        if base in _PAINTERS:
            return _PAINTERS[base]
    raise TypeError(f"nothing draws a {kind.__name__}: import giantlike first")


class Pictured:
    """Base of values that can be drawn: ``plot`` on axes, and a picture with the main numbers in a notebook."""

    __slots__ = ()

    def plot(self, axes: Axes | None = None, **options: Any) -> Axes:
        """Draw on axes, by default those of a new pyplot figure, which a notebook shows below the cell.

        ``options`` are those of the painter: see docs/notebooks.md.
        """
        from matplotlib import pyplot

        # loads the backend; loaded within the style of a painter, it would not be the one of the notebook
        pyplot.draw_if_interactive()  # type: ignore[no-untyped-call]
        return painter_of(type(self))(self, axes, **options)

    def _repr_html_(self) -> str:
        import base64
        import html
        import io

        from matplotlib import pyplot
        from matplotlib.figure import Figure

        buffer = io.BytesIO()
        figure = self.plot().get_figure(root=True)
        assert isinstance(figure, Figure)
        figure.savefig(buffer, format="png", dpi=72)
        pyplot.close(figure)  # a notebook would show it a second time
        picture = base64.b64encode(buffer.getvalue()).decode("ascii")
        caption = f"<figcaption>{html.escape(repr(self))}</figcaption>"
        return f'<figure><img src="data:image/png;base64,{picture}">{caption}</figure>'
