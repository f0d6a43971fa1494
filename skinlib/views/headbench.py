"""HeadBench as a page: tables and figures of the results of a bench."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np
from matplotlib.colors import LogNorm

from skinlib.head import HeadError
from skinlib.headbench.bench import MEMORY
from skinlib.headbench.networks import OURS
from skinlib.headbench.suites import SUITES
from skinlib.headbench.targets import UNTOUCHED, Target
from skinlib.io import atomic
from skinlib.views.picture import INK, Picture, new_figure, rasterise
from skinlib.views.plots import OURS as OUR_COLOUR
from skinlib.views.plots import method_scatter

# Metric, column title, digits.
COLUMNS = (
    ("row_l1_mean", "row-L1", 3),
    ("face_row_l1_mean", "face", 3),
    ("row_l1_p95", "p95", 2),
    ("row_l1_p99", "p99", 2),
    ("l1_mean_over_bones", "mean over V × J", 4),
    ("precision", "precision", 3),
    ("recall", "recall", 3),
    ("dominant_bone_accuracy", "strongest bone right", 3),
    ("bone_iou_mean", "bone IoU", 3),
    ("deformation_mean", "deformation %", 3),
    ("jaw_open_mean", "jaw open %", 3),
    ("blink_mean", "blink %", 3),
    ("smile_mean", "smile %", 3),
    ("lip_bleed", "lip bleed", 3),
    ("lid_bleed", "lid bleed", 3),
    ("left_right_bleed", "left/right bleed", 4),
    ("symmetry_error", "asymmetry", 3),
    ("at_4_row_l1_mean", "row-L1 at 4", 3),
    ("at_8_row_l1_mean", "row-L1 at 8", 3),
    ("seconds", "seconds", 2),
    (MEMORY, "MB", 0),
)


def write_page(results: Mapping, targets: Sequence[Target], out: Path) -> Path:
    """Write `index.html` and its figures into a folder, and return the page's path.

    Args:
        results: what `skinlib.headbench.bench.collect` returns.
        targets: of `skinlib.headbench.targets`.

    Raises:
        HeadError: no method was judged.
    """
    if not results.get(UNTOUCHED):
        raise HeadError("methods", "no method gave weights", "see what was printed")
    out.mkdir(parents=True, exist_ok=True)
    pictures = {
        "methods.png": methods_picture(results),
        "suites.png": suites_picture(results),
        "cost.png": cost_picture(results),
    }
    for name, picture in pictures.items():
        picture.save(out / name)
    page = _PAGE.render(
        pictures={name: picture.caption for name, picture in pictures.items()},
        tables=[methods_table(results), suites_table(results)],
        targets=[target.row() for target in targets],
        suites={name: suite.text for name, suite in SUITES.items() if name in results},
    )
    with atomic(out / "index.html") as file:
        file.write(page.encode())
    return out / "index.html"


def ranked(results: Mapping, suite: str = UNTOUCHED) -> list[str]:
    """Names of the methods judged on a suite, best row-L1 first."""
    methods = results.get(suite, {})
    return sorted(methods, key=lambda name: methods[name]["row_l1_mean"]["mean"])


def methods_table(results: Mapping) -> list[list[str]]:
    """Every metric of every method on untouched heads, as words; titles first."""
    rows = [["method", "heads", *(title for _, title, _ in COLUMNS)]]
    for name in ranked(results):
        numbers = results[UNTOUCHED][name]
        cells = [_number(numbers.get(metric), digits) for metric, _, digits in COLUMNS]
        rows.append([name, str(numbers["row_l1_mean"]["heads"]), *cells])
    return rows


def suites_table(results: Mapping) -> list[list[str]]:
    """Row-L1 of every method on every suite, as words; titles first."""
    rows = [["suite", *ranked(results)]]
    for suite, methods in results.items():
        cells = [
            _number(methods.get(name, {}).get("row_l1_mean"), 3) for name in rows[0][1:]
        ]
        rows.append([suite, *cells])
    return rows


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table, its titles first, as Markdown.

    >>> print(markdown([["method", "row-L1"], ["ours", "0.05"]]))
    | method | row-L1 |
    |---|---|
    | ours | 0.05 |
    """
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _number(cell: Mapping | None, digits: int) -> str:
    if cell is None:
        return "-"
    spread = f" ± {cell['spread']:.{digits}f}" if cell["spread"] else ""
    return f"{cell['mean']:.{digits}f}{spread}"


def methods_picture(results: Mapping) -> Picture:
    """A bar a method with the spread of the folds, the best at the top."""
    names = ranked(results)
    cells = [results[UNTOUCHED][name]["row_l1_mean"] for name in names]
    with new_figure(6.8, 1.2 + 0.32 * len(names)) as figure:
        axes = figure.subplots()
        axes.barh(
            range(len(names)),
            [cell["mean"] for cell in cells],
            xerr=[cell["spread"] for cell in cells],
            color=[_colour(name) for name in names],
            error_kw={"ecolor": INK, "elinewidth": 1, "capsize": 2},
        )
        for y, cell in enumerate(cells):
            text = f"{cell['mean']:.3f}"
            right = cell["mean"] + cell["spread"]
            axes.annotate(text, (right, y), (5, 0), size=8, va="center",
                          textcoords="offset points")  # fmt: skip
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.margins(x=0.12)
        axes.set_xlabel("row-L1, mean over vertices (0 = perfect, 2 = all wrong)")
        title = "Heads of topology groups that no method has seen"
        axes.set_title(title, weight="bold")
        return rasterise(figure, title, "line: spread of the folds")


def suites_picture(results: Mapping) -> Picture:
    """Row-L1 of methods x suites as a coloured matrix; empty: not judged."""
    names, suites = ranked(results), list(results)
    table = np.full((len(names), len(suites)), np.nan)
    for x, suite in enumerate(suites):
        for y, name in enumerate(names):
            if name in results[suite]:
                table[y, x] = results[suite][name]["row_l1_mean"]["mean"]
    with new_figure(2.2 + 0.4 * len(suites), 1.7 + 0.24 * len(names)) as figure:
        axes = figure.subplots()
        norm = LogNorm(max(1e-3, np.nanmin(table)), np.nanmax(table))
        axes.imshow(table, cmap="viridis_r", norm=norm, aspect="auto")
        for (y, x), value in np.ndenumerate(table):
            if np.isfinite(value):
                ink = "white" if norm(value) > 0.5 else INK
                axes.text(x, y, f"{value:.2f}".lstrip("0"), ha="center", va="center",
                          size=7.5, color=ink)  # fmt: skip
        axes.set_xticks(range(len(suites)), suites, rotation=40, ha="right")
        axes.set_yticks(range(len(names)), names)
        axes.tick_params(length=0)
        title = "row-L1 of each method on each suite"
        axes.set_title(title, weight="bold")
        return rasterise(figure, title)


def cost_picture(results: Mapping) -> Picture:
    """Error against seconds a head."""
    means = {
        name: {"mean": {k: cell["mean"] for k, cell in numbers.items()}}
        for name, numbers in results[UNTOUCHED].items()
    }
    return method_scatter({"methods": means}, ours=OURS)


def _colour(name: str) -> str:
    return OUR_COLOUR if name.startswith("skinlib") else "#b6c2cf"


_PAGE = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(
    """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>HeadBench</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto;
        padding: 0 1em; color: #1f2933 }
 .wide { overflow-x: auto }
 table { border-collapse: collapse; font-size: 13px; margin: 1em 0 }
 th, td { padding: .25em .6em; text-align: right; white-space: nowrap;
          border-bottom: 1px solid #e5e7eb }
 th:first-child, td:first-child { text-align: left; position: sticky; left: 0;
          background: white }
 img { max-width: 100% }
 .missed { color: #b42318 } .met { color: #067647 }
</style>
<h1>HeadBench</h1>
<p>Skin weights for heads: every method, on heads of topology groups that it has never
seen. row-L1 is the sum over bones of |predicted - artist's| weight, mean over vertices:
0 is perfect, 2 is all wrong. Each number: mean over heads ± spread of the folds' means;
every fold has its own heads and its own training seed.</p>
{% for file, caption in pictures.items() %}
<p><img src="{{ file }}" alt="{{ caption }}"></p>
{% endfor %}
<h2>What was asked</h2>
<table><tr><th>target<th>asked<th>measured<th></tr>
{% for row in targets %}
<tr>{% for cell in row %}<td class="{{ cell }}">{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table>
{% for rows in tables %}
<h2>{{ ["Untouched heads", "row-L1 on every suite"][loop.index0] }}</h2>
<div class="wide"><table>
<tr>{% for cell in rows[0] %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for row in rows[1:] %}
<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table></div>
{% endfor %}
<h2>The suites</h2>
<dl>{% for name, text in suites.items() %}
<dt><b>{{ name }}</b><dd>{{ text }}
{% endfor %}</dl>
</html>
"""
)
