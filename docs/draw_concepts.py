"""Drawings of docs/concepts as SVG: ``python docs/draw_concepts.py`` writes them to docs/images/concepts.

Each drawing is a card of its own light background, so that it reads in light and dark themes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

FOLDER = Path(__file__).parent / "images" / "concepts"
PAPER, INK, FAINT = "#fbfaf6", "#22303c", "#9aa5ad"
BLUE, RED, GREEN, GOLD, BODY, DARK = "#1f6fb2", "#c0392b", "#2e8b57", "#a97700", "#d8d2c4", "#4b5560"


class Drawing:
    """An SVG picture with words; coordinates are px from the upper left."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def line(self, start: Sequence[float], end: Sequence[float], color: str = INK, *, width: float = 1.5,
             dash: str = "", arrow: bool = False) -> None:  # fmt: skip
        """Draw a line, with a head at its end if asked."""
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<line x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" stroke="{color}" '
            f'stroke-width="{width}"{extra}/>'
        )
        if arrow:
            angle = math.atan2(end[1] - start[1], end[0] - start[0])
            sides = [(end[0] - 9 * math.cos(angle + turn), end[1] - 9 * math.sin(angle + turn)) for turn in (-0.4, 0.4)]
            self.polygon([end, *sides], fill=color, stroke="none")

    def polygon(self, points: Iterable[Sequence[float]], *, fill: str = "none", stroke: str = INK, width: float = 1.5,
                closed: bool = True) -> None:  # fmt: skip
        """Draw a polygon, or a line through points."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        tag = "polygon" if closed else "polyline"
        self.parts.append(f'<{tag} points="{path}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>')

    def ellipse(self, center: Sequence[float], radii: Sequence[float], *, fill: str = "none", stroke: str = INK,
                width: float = 1.5, turn: float = 0.0, dash: str = "") -> None:  # fmt: skip
        """Draw an ellipse, turned by degrees."""
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<ellipse cx="{center[0]:.1f}" cy="{center[1]:.1f}" rx="{radii[0]:.1f}" ry="{radii[1]:.1f}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{width}"{extra} '
            f'transform="rotate({turn} {center[0]:.1f} {center[1]:.1f})"/>'
        )

    def rect(self, corner: Sequence[float], size: Sequence[float], *, fill: str = "none", stroke: str = INK,
             width: float = 1.5) -> None:  # fmt: skip
        """Draw a rectangle."""
        self.parts.append(
            f'<rect x="{corner[0]:.1f}" y="{corner[1]:.1f}" width="{size[0]:.1f}" height="{size[1]:.1f}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{width}"/>'
        )

    def dot(self, center: Sequence[float], color: str = INK, radius: float = 3.5) -> None:
        """Draw a dot."""
        self.ellipse(center, (radius, radius), fill=color, stroke="none")

    def cross(self, center: Sequence[float], color: str = RED, size: float = 6.0) -> None:
        """Draw an upright cross."""
        x, y = center
        self.line((x - size, y), (x + size, y), color, width=2)
        self.line((x, y - size), (x, y + size), color, width=2)

    def text(self, place: Sequence[float], words: str, color: str = INK, *, size: int = 13, anchor: str = "start",
             bold: bool = False) -> None:  # fmt: skip
        """Write a line of words."""
        weight = ' font-weight="bold"' if bold else ""
        words = words.replace("&", "&amp;").replace("<", "&lt;")
        self.parts.append(
            f'<text x="{place[0]:.1f}" y="{place[1]:.1f}" fill="{color}" font-size="{size}" '
            f'text-anchor="{anchor}"{weight}>{words}</text>'
        )

    def svg(self) -> str:
        """Return the file's text."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" width="{self.width}" '
            f'height="{self.height}" role="img" font-family="Helvetica, Arial, sans-serif">\n'
            f"<title>{self.title}</title>\n"
            f'<rect x="1" y="1" width="{self.width - 2}" height="{self.height - 2}" rx="10" fill="{PAPER}" '
            f'stroke="{FAINT}"/>\n' + "\n".join(self.parts) + "\n</svg>\n"
        )


def rock(center: Sequence[float], radius: float, *, stretch: float = 1.0, turn: float = 0.0) -> list[list[float]]:
    """Outline of a made-up irregular body."""
    outline = []
    for step in range(90):
        angle = 2 * math.pi * step / 90
        size = radius * (1 + 0.13 * math.sin(2 * angle + 0.5) + 0.06 * math.sin(5 * angle) + 0.03 * math.sin(9 * angle))
        outline.append([center[0] + stretch * size * math.cos(angle + turn), center[1] + size * math.sin(angle + turn)])
    return outline


def lit_disk(picture: Drawing, center: Sequence[float], radius: float, *, phase_deg: float = 70.0) -> None:
    """Draw a disk lit from the left, with its dark side and terminator."""
    picture.ellipse(center, (radius, radius), fill=DARK, stroke="none")
    edge = [
        (center[0] - radius * math.sin(a), center[1] - radius * math.cos(a))
        for a in (math.pi * k / 40 for k in range(41))
    ]
    bulge = math.cos(math.radians(phase_deg))
    back = [
        (center[0] + bulge * radius * math.sin(a), center[1] + radius * math.cos(a))
        for a in (math.pi * k / 40 for k in range(41))
    ]
    picture.polygon([*edge, *back], fill=BODY, stroke="none")
    picture.ellipse(center, (radius, radius), width=1)


def frames() -> Drawing:
    """Pixels, corners and axes."""
    d = Drawing(720, 330, "Pixel centers, rows and camera axes")
    left, top, cell = 90, 80, 56
    for row in range(3):
        for column in range(4):
            d.rect((left + column * cell, top + row * cell), (cell, cell), stroke=FAINT)
            d.dot((left + (column + 0.5) * cell, top + (row + 0.5) * cell), FAINT, 2.5)
    d.dot((left + cell / 2, top + cell / 2), BLUE, 5)
    d.text((left + cell / 2 + 7, top + cell / 2 + 16), "(0, 0)", BLUE)
    d.dot((left, top), RED, 4)
    d.text((left - 82, top - 8), "(-0.5, -0.5)", RED)
    d.dot((left + 2.5 * cell, top + 1.5 * cell), GREEN, 5)
    d.text((left + 2.5 * cell - 24, top + 1.5 * cell + 19), "(2, 1)", GREEN)
    d.line((left + cell / 2, top - 28), (left + 3.9 * cell, top - 28), arrow=True)
    d.text((left + 4 * cell + 2, top - 24), "x, column")
    d.line((left - 24, top + cell / 2), (left - 24, top + 2.9 * cell), arrow=True)
    d.text((left - 62, top + 3 * cell + 18), "y, row")
    d.text((left, top + 3 * cell + 46), "(2, 1) is image.pixels[1, 2]; FITS, ISIS and VICAR call it (3, 2)", DARK)
    d.text((left, top + 3 * cell + 66), "and programs that count from corners (2.5, 1.5)", DARK)
    x, y = 500, 110
    d.text((x - 30, y - 40), "camera axes", bold=True)
    d.line((x, y), (x + 100, y), BLUE, width=2.5, arrow=True)
    d.text((x + 106, y + 4), "+x along columns", BLUE, size=12)
    d.line((x, y), (x, y + 100), BLUE, width=2.5, arrow=True)
    d.text((x - 8, y + 118), "+y along rows", BLUE, size=12)
    d.ellipse((x, y), (9, 9), stroke=RED, width=2)
    d.line((x - 6, y - 6), (x + 6, y + 6), RED, width=2)
    d.line((x - 6, y + 6), (x + 6, y - 6), RED, width=2)
    d.text((x + 20, y + 30), "+z away from you,", RED, size=12)
    d.text((x + 20, y + 46), "out of the lens", RED, size=12)
    return d


def mirrored() -> Drawing:
    """What rows in the wrong order do to the sky."""
    d = Drawing(720, 250, "Rows in the wrong order mirror the sky")
    stars = [(30, 40, 5), (70, 25, 3), (110, 60, 4), (60, 90, 3), (130, 110, 5)]
    for offset, flip, words, color in (
        (40, False, "the sky, first row on top", GREEN),
        (280, True, "rows turned around", RED),
    ):
        d.rect((offset, 40), (160, 140))
        places = [(offset + x, 40 + (140 - y if flip else y)) for x, y, _ in stars]
        d.polygon(places[:3], stroke=color)
        for place, (_, _, size) in zip(places, stars, strict=True):
            d.dot(place, INK, size)
        d.text((offset + 80, 30), words, color, anchor="middle")
    d.text((480, 70), "The triangle runs the other way around.")
    d.text((480, 94), "No turn of the camera makes one")
    d.text((480, 114), "of the other: mirrored_image.")
    d.text((480, 148), "bottom_up = true turns the rows back.", GREEN)
    d.text((40, 214), "How a viewer draws the picture does not matter; which row is stored first does.", DARK)
    return d


def light_time() -> Drawing:
    """Where the body was, is, and seems to be."""
    d = Drawing(720, 380, "Geometric, astrometric and apparent place")
    camera, then, now, seems = (90, 320), (420, 70), (560, 110), (470, 48)
    d.line((441, 76), (680, 144), FAINT, dash="5 4", arrow=True)
    d.text((600, 164), "path of the body", DARK, size=12)
    d.ellipse(then, (20, 20), fill=BODY)
    d.ellipse(now, (20, 20), fill=PAPER, dash="4 3")
    d.line(camera, then, BLUE, width=2)
    d.line(camera, now, GREEN, width=1.8, dash="8 4")
    d.line(camera, seems, RED, width=2)
    d.dot(seems, RED, 4)
    d.text((392, 58), "where it was when", size=12, anchor="end")
    d.text((392, 73), "the light left", size=12, anchor="end")
    d.text((585, 100), "where it is at the", size=12)
    d.text((585, 115), "epoch of the image", size=12)
    d.dot(camera, INK, 6)
    d.text((50, 345), "spacecraft at the epoch")
    d.line((camera[0], camera[1]), (camera[0] + 95, camera[1]), GOLD, width=3, arrow=True)
    d.text((camera[0] + 102, camera[1] + 4), "its velocity, about the barycenter", GOLD)
    d.text((484, 34), "apparent: the camera sees it here,", RED, bold=True)
    d.text((484, 52), "turned toward the velocity (aberration)", RED)
    d.text((24, 150), "astrometric:", BLUE, bold=True)
    d.text((24, 168), "aberration removed", BLUE)
    d.text((370, 250), "geometric: light time removed, too", GREEN, bold=True)
    d.text((370, 270), "(the vector between both at one time)", GREEN)
    return d


def covariance() -> Drawing:
    """Which errors rows share."""
    d = Drawing(720, 330, "Errors by cause, and what images share")
    names = (
        ("noise, background", BLUE, "new in each image"),
        ("attitude", GREEN, "the same between two star images"),
        ("psf, edge, camera", GOLD, "the same in all images of a camera"),
        ("scale, pole, relief, law", RED, "the same in all images of a body"),
    )
    for index, (name, color, words) in enumerate(names):
        y = 60 + 60 * index
        d.text((24, y + 20), name, color, bold=True)
        groups = ([1] * 8, [2, 2, 2, 2], [8], [8])[index]
        x = 210.0
        for group in groups:
            d.rect((x, y), (34 * group - 6, 28), fill=color, stroke="none")
            x += 34 * group
        d.text((500, y + 20), words, DARK)
    for index in range(8):
        d.text((224 + 34 * index, 45), f"{index + 1}", FAINT, anchor="middle")
    d.text((150, 45), "image", FAINT)
    d.text(
        (24, 312), "Eight rows hold eight draws of the first, four of the second, and one of each of the others.", DARK
    )
    return d


def stars() -> Drawing:
    """From detections to an attitude."""
    d = Drawing(720, 260, "Star identification in four steps")
    places = [(30, 40), (80, 30), (110, 75), (55, 95), (95, 120), (30, 115)]
    titles = ("1 detect, flag", "2 patterns", "3 match all", "4 fit, weigh")
    for step, title in enumerate(titles):
        x0 = 24 + 174 * step
        d.rect((x0, 50), (150, 150))
        d.text((x0 + 75, 38), title, bold=True, anchor="middle")
        for index, (x, y) in enumerate(places):
            place = (x0 + x, 50 + y)
            if step == 1 and index not in (0, 1, 2, 3):
                d.dot(place, FAINT, 3)
                continue
            d.dot(place, INK, 3 + (index % 3))
            if step >= 2 and index != 4:
                d.ellipse(place, (9, 9), stroke=GREEN)
            if step == 3 and index != 4:
                d.line(place, (place[0] + 12 * math.sin(3 * index), place[1] + 12 * math.cos(5 * index)), RED, width=2)
        if step == 0:
            d.line((x0 + 110, 170), (x0 + 140, 190), RED, width=3)
            d.text((x0 + 60, 192), "particle", RED, size=11)
        if step == 1:
            d.polygon([(x0 + x, 50 + y) for x, y in (places[0], places[1], places[2], places[3])], stroke=BLUE)
            d.text((x0 + 8, 192), "angles and ratios", BLUE, size=11)
        if step == 2:
            d.text((x0 + 8, 192), "chance below 1e-6", GREEN, size=11)
        if step == 3:
            d.text((x0 + 8, 192), "residuals, error floor", RED, size=11)
    d.text(
        (24, 232),
        "With an a priori attitude 2 is nearest neighbors within 100 px; without one, an index of the whole sky.",
        DARK,
    )
    return d


def unresolved() -> Drawing:
    """A body of two pixels."""
    d = Drawing(560, 230, "unresolved: the body rendered through the optics")
    for row in range(5):
        for column in range(5):
            weight = math.exp(-((column - 1.8) ** 2 + (row - 2.1) ** 2) / 1.7)
            shade = int(245 - 200 * weight)
            d.rect(
                (40 + 34 * column, 34 + 34 * row),
                (34, 34),
                fill=f"rgb({shade},{shade},{shade})",
                stroke=FAINT,
                width=0.5,
            )
    d.ellipse((132, 120), (36, 30), stroke=BLUE, width=2)
    d.cross((132, 120), RED)
    d.dot((112, 117), GOLD, 4)
    d.text((240, 70), "the body, rendered, blurred, fitted", BLUE)
    d.text((240, 100), "center of figure: the answer", RED)
    d.text((240, 130), "center of light: toward the Sun", GOLD)
    d.text((240, 170), "fails: a star beside it, motion,", DARK)
    d.text((240, 188), "more than 12 px, a clipped core", DARK)
    return d


def moment() -> Drawing:
    """Center of brightness."""
    d = Drawing(560, 230, "moment: center of light and its correction")
    lit_disk(d, (130, 115), 78)
    d.rect((38, 24), (184, 182), stroke=GREEN)
    d.dot((86, 115), GOLD, 5)
    d.cross((130, 115), RED)
    d.line((86, 115), (124, 115), GOLD, width=2, arrow=True)
    d.text((244, 62), "all light of the disk, sky removed", GREEN)
    d.text((244, 92), "center of light", GOLD)
    d.text((244, 122), "correction by the rendered body", RED)
    d.text((244, 164), "fails: cut by the frame, rings, markings,", DARK)
    d.text((244, 182), "a law that is far from the one told", DARK)
    return d


def cross_correlation() -> Drawing:
    """Template and peak."""
    d = Drawing(560, 230, "cross_correlation: a template moved over the image")
    d.rect((30, 30), (180, 170))
    d.polygon(rock((130, 118), 48, stretch=1.15), fill=BODY, stroke=INK)
    d.polygon(rock((104, 98), 48, stretch=1.15), stroke=BLUE)
    d.line((104, 98), (126, 115), RED, width=2.5, arrow=True)
    for size, color in ((46, "#e6e2d8"), (34, "#cdd9e3"), (22, "#9fbdd6"), (10, BLUE)):
        d.ellipse((300, 112), (size, size * 0.8), fill=color, stroke="none")
    d.cross((300, 112), RED)
    d.text((262, 176), "correlation by shift", DARK, size=12)
    d.text((370, 70), "rendered, blurred", BLUE)
    d.text((370, 100), "place, range, blur fitted", RED)
    d.text((370, 140), "fails: another shape or", DARK)
    d.text((370, 158), "pole, Sun elsewhere,", DARK)
    d.text((370, 176), "no likeness at all", DARK)
    return d


def limb_matching() -> Drawing:
    """Lines across the limb of any shape."""
    d = Drawing(560, 230, "limb_matching: lines across the predicted outline")
    outline = rock((135, 115), 74, stretch=1.05)
    d.polygon(outline, fill=BODY, stroke="none")
    d.polygon([(x + 5, y - 4) for x, y in outline], stroke=BLUE)
    for index in range(28, 66, 3):
        x, y = outline[index]
        angle = math.atan2(y - 115, x - 135)
        d.line(
            (x - 14 * math.cos(angle), y - 14 * math.sin(angle)),
            (x + 14 * math.cos(angle), y + 14 * math.sin(angle)),
            RED,
            width=1.2,
        )
        d.dot((x, y), RED, 2.5)
    d.text((252, 62), "predicted outline", BLUE)
    d.text((252, 92), "brightness along each line, against a", RED)
    d.text((252, 110), "rendered one: one point a line", RED)
    d.text((252, 140), "only the lit limb, not the terminator", GREEN)
    d.text((252, 172), "fails: below 40 px, haze, a short arc", DARK)
    d.text((252, 190), "(place and range then move together)", DARK)
    return d


def ellipse_fit() -> Drawing:
    """Edges and a free ellipse."""
    d = Drawing(560, 230, "ellipse_fit: an ellipse through the edges")
    lit_disk(d, (130, 115), 76, phase_deg=60)
    for step in range(15):
        angle = math.pi / 2 + math.pi * (step + 0.5) / 15
        d.dot((130 + 76 * math.cos(angle), 115 - 76 * math.sin(angle)), RED, 3)
    for y in (60, 115, 150):
        d.line((30, y), (230, y), FAINT, dash="4 4")
    d.ellipse((130, 115), (79, 75), stroke=BLUE, width=2)
    d.line((20, 20), (52, 20), GOLD, width=2.5, arrow=True)
    d.text((58, 25), "sunlight", GOLD, size=12)
    d.text((256, 62), "edges along the sunlight, by moments", RED)
    d.text((256, 92), "a free ellipse says which are of the limb,", BLUE)
    d.text((256, 110), "the known axes give place and range", BLUE)
    d.text((256, 140), "needs no law of reflectance", GREEN)
    d.text((256, 172), "fails: no ellipsoid, below 30 px at a", DARK)
    d.text((256, 190), "crescent; sigmas are wide", DARK)
    return d


def ellipsoid_cra() -> Drawing:
    """The cone that touches the horizon."""
    d = Drawing(560, 230, "ellipsoid_cra: the cone that touches the horizon")
    eye = (40, 120)
    d.ellipse((400, 110), (92, 66), fill=BODY, turn=-8)
    for end in ((374, 43), (384, 176)):
        d.line(eye, end, RED)
    d.ellipse((379, 110), (13, 67), stroke=RED, width=2, dash="5 3", turn=-4)
    d.line(eye, (400, 110), BLUE, width=2, arrow=True)
    d.dot(eye, INK, 6)
    d.text((24, 145), "camera")
    d.polygon([(120, 86), (120, 146)], stroke=GREEN, width=3, closed=False)
    d.text((100, 166), "image", GREEN, size=12)
    d.text((160, 30), "lines of sight to the lit horizon touch the ellipsoid:", RED)
    d.text((160, 205), "where all of them do, there is the body (Christian-Robinson)", BLUE)
    d.text((404, 140), "radii known", DARK, size=12)
    return d


def sigmoid_limb() -> Drawing:
    """The profile across the limb."""
    d = Drawing(560, 230, "sigmoid_limb: one blurred horizon through all pixels")
    base, top, middle = 180.0, 60.0, 165.0
    curve = [(x, base - (base - top) / (1 + math.exp((x - middle) / 13))) for x in range(50, 290, 4)]
    d.line((40, base), (300, base), arrow=True)
    d.line((50, 195), (50, 35), arrow=True)
    d.text((100, 204), "across the limb, outward", DARK, size=12)
    d.text((58, 40), "brightness", DARK, size=12)
    for index, (x, y) in enumerate(curve[::4]):
        d.dot((x, y + 5 * math.sin(7 * index)), INK, 2.5)
    d.polygon(curve, stroke=BLUE, width=2.2, closed=False)
    d.line((middle, 45), (middle, base), RED, dash="5 3")
    d.text((middle + 6, 60), "horizon", RED)
    d.text((320, 70), "one horizon moves until all", BLUE)
    d.text((320, 88), "profiles fit at once", BLUE)
    d.text((320, 120), "gain and slope free in each cell,", GREEN)
    d.text((320, 138), "blur common to all", GREEN)
    d.text((320, 172), "fails: no ellipsoid, relief within", DARK)
    d.text((320, 190), "a cell, a disk that is clipped", DARK)
    return d


def surface_features() -> Drawing:
    """Landmarks and their shifts."""
    d = Drawing(560, 230, "surface_features: landmarks rendered and found")
    d.rect((30, 24), (220, 180), fill=BODY)
    for x, y, size in ((70, 66, 18), (150, 56, 12), (205, 100, 20), (95, 135, 14), (170, 160, 17)):
        d.ellipse((x, y), (size, size * 0.8), fill="#c3bba8", stroke=DARK, width=1)
        d.rect((x - 26, y - 22), (46, 38), stroke=BLUE)
        d.line((x - 3, y - 3), (x + 9, y + 6), RED, width=2, arrow=True)
    d.line((214, 178), (196, 196), FAINT, width=3)
    d.text((270, 62), "predicted places, rendered patches", BLUE)
    d.text((270, 92), "shifts: what most share is found first,", RED)
    d.text((270, 110), "those that do not agree are rejected", RED)
    d.text((270, 140), "no limb needed; fills the frame", GREEN)
    d.text((270, 172), "fails: a wrong map, low Sun or none,", DARK)
    d.text((270, 190), "fewer than 6 landmarks in view", DARK)
    return d


def auto() -> Drawing:
    """Choice, check and fusion."""
    d = Drawing(720, 210, "auto: choose, check by another, fuse")
    boxes = (
        (24, 88, "size, shape,", "limb in view", INK),
        (186, 88, "first choice", "that is not suspect", BLUE),
        (404, 30, "a second estimator", "that uses something else", GREEN),
    )
    for x, y, first, second, color in boxes:
        width = 180 if x > 100 else 124
        d.rect((x, y), (width, 56), stroke=color, width=2)
        d.text((x + width / 2, y + 24), first, color, anchor="middle")
        d.text((x + width / 2, y + 44), second, color, anchor="middle", size=12)
    d.line((148, 116), (184, 116), arrow=True)
    d.line((368, 104), (402, 66), arrow=True)
    for y, words, color in (
        (120, "agree: fused, one covariance", GREEN),
        (152, "differ: fused, larger sigmas", BLUE),
        (184, "none confirms it: unchecked", GOLD),
    ):
        d.line((476, y - 4), (488, y - 4), color, width=2)
        d.text((494, y), words, color, size=12)
    d.line((476, 88), (476, 180), FAINT)
    return d


def judged() -> Drawing:
    """From an estimate to flags and a sigma."""
    d = Drawing(720, 340, "How a fix is judged: tests raise flags, imprecision makes the sigma larger")

    def box(corner: Sequence[float], width: float, first: str, second: str, color: str) -> None:
        d.rect(corner, (width, 52), stroke=color, width=2)
        d.text((corner[0] + width / 2, corner[1] + 22), first, color, anchor="middle")
        d.text((corner[0] + width / 2, corner[1] + 41), second, color, anchor="middle", size=12)

    box((20, 136), 118, "estimator", "position, sigma", BLUE)
    box((186, 136), 140, "coarse render", "at that position", INK)
    tests = (
        (50, "facts of the fit", "search, points used", BLUE),
        (110, "another model?", "Bayes factor > 1000", RED),
        (170, "another position?", "within 1 : 1000", RED),
        (230, "off the prediction?", "p < 0.001", RED),
        (290, "moved, sheared, blurred?", "tension > 1", GREEN),
    )
    for y, first, second, color in tests:
        box((362, y - 26), 178, first, second, color)
    d.line((138, 154), (184, 154), arrow=True)
    d.line((186, 172), (140, 172), GREEN, arrow=True)
    d.text((256, 210), "nonlinear response, haze:", GREEN, size=12, anchor="middle")
    d.text((256, 226), "the fix is repeated with it", GREEN, size=12, anchor="middle")
    d.line((79, 136), (79, 50), BLUE)
    d.line((79, 50), (360, 50), BLUE, arrow=True)
    for y in (110, 170, 230, 290):
        d.line((326, 162), (360, y), arrow=True)
    flags = (
        (38, "many_rejected, low_score,", RED), (54, "far_from_prediction", RED),
        (96, "wrong_light", RED), (112, "unexplained_light", RED), (128, "wrong_figure", RED),
        (174, "ambiguous", RED), (234, "far_from_prediction", RED),
        (286, "larger sigma,", GREEN), (302, "no flag", GREEN),
    )  # fmt: skip
    for y, words, color in flags:
        d.text((548, y), words, color, size=12)
    return d


def architecture() -> Drawing:
    """From pixels to observables, with the packages that do it."""
    d = Drawing(820, 380, "From image to observables: values in boxes, the package of each step on its arrow")

    def box(corner: Sequence[float], size: Sequence[float], title: str, words: Sequence[str], color: str) -> None:
        d.rect(corner, size, stroke=color, width=2)
        middle = corner[0] + size[0] / 2
        d.text((middle, corner[1] + 20), title, color, anchor="middle", bold=True)
        for row, line in enumerate(words):
            d.text((middle, corner[1] + 38 + 16 * row), line, DARK, anchor="middle", size=12)

    box((20, 150), (160, 72), "Image", ("pixels, mask, epoch,", "attitude, detector"), INK)
    box((20, 40), (160, 72), "Camera", ("lens, point spread", "function, detector"), INK)
    box((20, 260), (160, 88), "Scene", ("targets: shape, position,", "orientation, Sun,", "uncertainty"), INK)
    box((270, 96), (150, 72), "Attitude", ("rotation, covariance,", "flags"), BLUE)
    box((270, 236), (150, 88), "Fix", ("center or position,", "covariance by cause,", "flags, findings"), RED)
    box((530, 150), (146, 72), "Observables", ("directions, parts,", "partials, shared keys"), GREEN)
    d.line((180, 170), (268, 132), arrow=True)
    d.text((190, 146), "stars", BLUE, size=12)
    d.line((180, 190), (268, 270), arrow=True)
    d.line((180, 80), (268, 118), arrow=True)
    d.line((180, 304), (268, 290), arrow=True)
    d.text((194, 322), "relative", RED, size=12)
    d.line((345, 168), (345, 234), arrow=True)
    d.text((352, 206), "with_attitude", BLUE, size=12)
    d.line((420, 132), (528, 176), arrow=True)
    d.line((420, 280), (528, 200), arrow=True)
    d.text((446, 188), "observables", GREEN, size=12)
    d.line((676, 186), (706, 186), arrow=True)
    d.text((712, 160), "filter, orbit", DARK, size=12)
    d.text((712, 178), "determination,", DARK, size=12)
    d.text((712, 196), "CK, TDM, AEM,", DARK, size=12)
    d.text((712, 214), "tables, report", DARK, size=12)
    d.text((270, 40), "catalogs: where stars are; calibration: a camera from stars", DARK, size=12)
    d.text((270, 58), "processing: detection, limbs, geometry of arrays", DARK, size=12)
    d.text((270, 344), "shapes, ray_tracing: what the body looks like; image_model: linear fits", DARK, size=12)
    d.text((270, 362), "relative/judge, relative/verification: tests behind every fix", DARK, size=12)
    d.text((530, 250), "campaign: all of this for", DARK, size=12)
    d.text((530, 266), "many images, from a file", DARK, size=12)
    return d


DRAWINGS: dict[str, Callable[[], Drawing]] = {
    each.__name__: each
    for each in (
        frames, mirrored, light_time, covariance, stars, unresolved, moment, cross_correlation, limb_matching,
        ellipse_fit, ellipsoid_cra, sigmoid_limb, surface_features, auto, judged, architecture,
    )
}  # fmt: skip
"""Drawings by the name of their file."""


def main() -> None:
    """Write all drawings."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, draw in DRAWINGS.items():
        (FOLDER / f"{name}.svg").write_text(draw().svg(), encoding="utf-8")


if __name__ == "__main__":
    main()
