"""report.html: one file that needs no other."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from host_tools.evaluation import Evaluation, TrajectoryErrors, closure_counts
from host_tools.registration import SEARCH_M
from host_tools.report import figures
from host_tools.results import MissionResult
from host_tools.writers import link_counts

DPI = 110
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em;
       color: #202020 }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: .6em 0 } th { text-align: left }
td, th { padding: .15em .9em .15em 0; vertical-align: top } td.n { text-align: right }
img { max-width: 100% } .note { color: #555 } li.warn { color: #a33 }
"""


def write_report(result: MissionResult, evaluation: Evaluation, path: Path) -> None:
    """Write the report of a mission."""
    sections = [
        _head(result),
        _section("Errors", _error_table(evaluation)),
        _section("Trajectories", _image(figures.trajectories(result), "trajectories")),
        _section("Errors over time", _image(figures.errors_over_time(result), "errors")),
        _section("Map", _map_text(evaluation) + _image(figures.maps(result, evaluation), "map")),
        _section(
            "Loop closures",
            _closure_table(evaluation) + _image(figures.closures(result, evaluation), "closures"),
        ),
        _section("Observability and status", _remarks(result.remarks)),
        _section(
            "Link",
            _link_text(result)
            + _image(figures.link(result.deliveries, result.scenario.duration_s), "link"),
        ),
        _section("Counters", _counters(result.counters)),
    ]
    title = html.escape(f"Fathomlink: {result.scenario.name}, seed {result.seed}")
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body>{''.join(sections)}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _head(result: MissionResult) -> str:
    site, scenario = result.site, result.scenario
    facts = (
        ("terrain", site.raster.name),
        ("mission", f"{scenario.duration_min:g} min, {scenario.followers} follower(s)"),
        ("profile, baseline", f"{result.profile}, {result.baseline}"),
        ("loss", f"{scenario.water.loss:.0%} per receiver, {scenario.water.loss_model}"),
        ("origin", f"N {site.datum.origin_north_m:.1f} m, E {site.datum.origin_east_m:.1f} m"),
        ("datum", f"depth = {site.datum.depth_shift_m:.2f} m - elevation"),
        (
            "altitude",
            f"{site.mean_altitude_m:.1f} m in the mean, {site.minimum_altitude_m:.1f} m at least",
        ),
    )
    rows = [[html.escape(name), html.escape(text)] for name, text in facts]
    title = html.escape(f"{scenario.name}, seed {result.seed}")
    return f"<h1>{title}</h1>" + _table(None, rows, numeric=False)


def _section(title: str, body: str) -> str:
    return f"<h2>{html.escape(title)}</h2>{body}"


def _image(figure: Figure, alt: str) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<img alt="{alt}" src="data:image/png;base64,{data}">'


def _table(head: Sequence[str] | None, rows: Sequence[Sequence[str]], numeric: bool = True) -> str:
    kind = ' class="n"' if numeric else ""
    parts = ["<table>"]
    if head is not None:
        parts.append("<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>")
    for first, *rest in rows:
        cells = "".join(f"<td{kind}>{cell}</td>" for cell in rest)
        parts.append(f"<tr><td>{first}</td>{cells}</tr>")
    return "".join([*parts, "</table>"])


def _error_table(evaluation: Evaluation) -> str:
    head = ("", "mean", "RMS", "largest", "at the end", "of dead reckoning", "of distance", "NEES")
    rows = []
    for name, errors in evaluation.vehicles.items():
        surveyed = errors.live_during_survey
        kinds = (
            ("live", errors.live),
            *([] if surveyed == errors.live else [("live during its survey", surveyed)]),
            ("final", errors.final),
            ("dead reckoning", errors.dead_reckoning),
        )
        rows += [_error_row(f"{name.replace('_', ' ')}, {kind}", e) for kind, e in kinds]
    return _table(head, rows)


def _error_row(name: str, errors: TrajectoryErrors) -> list[str]:
    return [
        html.escape(name),
        f"{errors.mean_m:.2f} m",
        f"{errors.rmse_m:.2f} m",
        f"{errors.max_m:.2f} m",
        f"{errors.end_m:.2f} m",
        f"{errors.share_of_dead_reckoning:.1%}",
        f"{errors.percent_of_distance:.3f} %",
        "" if errors.nees is None else f"{errors.nees:.2f}",
    ]


def _map_text(evaluation: Evaluation) -> str:
    error, tiles = evaluation.registration, evaluation.tiles
    spread = f": median {tiles.median_m:.2f} m, 95 % {tiles.p95_m:.2f} m" if tiles.tiles else ""
    return (
        f"<p>Against the map of the same soundings placed by true navigation: mean "
        f"{error.mean_m:.3f} m, median {error.median_m:.3f} m, {error.share_under_half_m:.1%} "
        f"under 0.5 m, {error.share_under_1m:.1%} under 1 m ({error.cells} cells, "
        f"{error.mapped_share:.1%} of that map). "
        f"Horizontal shift of {tiles.tiles} tiles of 100 m{spread}; {tiles.far_tiles} more are "
        f"{SEARCH_M:.0f} m off or farther, {tiles.flat_tiles} too flat to say.</p>"
    )


def _closure_table(evaluation: Evaluation) -> str:
    rows = [
        [
            stage,
            f"{count['number']:.0f}",
            f"{count['valid']:.0f}",
            f"{count['valid_share']:.1%}" if count["number"] else "",
            f"{count['one_axis']:.0f}",
        ]
        for stage, count in closure_counts(evaluation.closures).items()
    ]
    note = '<p class="note">Valid: within 5 m of the truth; one-axis closures along their axis.</p>'
    return _table(("reached", "number", "valid", "share", "one-axis"), rows) + note


def _remarks(remarks: Sequence[str]) -> str:
    if not remarks:
        return "<p>The estimator reported nothing as unobservable.</p>"
    lines = [
        f"<li{' class=warn' if ': undetermined' in line else ''}>{html.escape(line)}</li>"
        for line in remarks
    ]
    return f"<ul>{''.join(lines)}</ul>"


def _link_text(result: MissionResult) -> str:
    counts = link_counts(result.deliveries)
    return (
        f"<p>{counts['packets_sent']} frames, {counts['bytes_on_air']} bytes on the air; "
        f"{counts['packets_lost']} of {counts['receptions_expected']} receptions failed.</p>"
    )


def _counters(counters: Mapping[str, Mapping[str, float]]) -> str:
    rows = [
        [html.escape(f"{owner}: {name}"), f"{value:g}"]
        for owner, group in counters.items()
        for name, value in group.items()
    ]
    return _table(None, rows)
