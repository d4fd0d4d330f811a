"""The report's figures: each function returns one matplotlib figure, east to the right."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from firmware.geometry import Array
from host_tools.evaluation import VALID_CLOSURE_M, Evaluation, JudgedClosure
from host_tools.results import STAGES, MissionResult
from protocol.acoustics import Delivery

COLOURS = {
    "truth": "#202020",
    "dead reckoning": "#b0b0b0",
    "live": "#e07b00",
    "final": "#0061b0",
}
VALID, FALSE = "#1a8f3c", "#c62828"
FATES = {
    "delivered": "#1a8f3c",
    "duplicate": "#8bc34a",
    "corrupt": "#9c27b0",
    "lost": "#c62828",
    "collision": "#e07b00",
    "half-duplex": "#795548",
    "out-of-reach": "#607d8b",
}


def _figure(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, list(axes)


def _panels(count: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return panels, two a row: more would be too small to read on the page."""
    columns, rows = min(count, 2), -(-count // 2)
    figure = Figure(figsize=(6.0 * columns, height * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def trajectories(result: MissionResult) -> Figure:
    """Return true, dead-reckoned, live and final tracks, one panel a vehicle."""
    figure, panels = _panels(len(result.vehicles), 5.6)
    for axes, vehicle in zip(panels, result.vehicles, strict=True):
        tracks = (
            ("dead reckoning", vehicle.dead_reckoning_m, 1.2),
            ("live", vehicle.live_m, 0.9),
            ("final", vehicle.final_m, 1.6),
        )
        for name, track_m, width in tracks:
            axes.plot(track_m[:, 1], track_m[:, 0], color=COLOURS[name], lw=width, label=name)
        truth = vehicle.truth
        axes.plot(
            truth.east_m, truth.north_m, color=COLOURS["truth"], lw=0.9, ls=":", label="truth"
        )
        axes.plot(truth.east_m[0], truth.north_m[0], "o", color=COLOURS["truth"], ms=5)
        axes.set(title=vehicle.name.replace("_", " "), xlabel="east (m)", ylabel="north (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.25)
    panels[0].legend(loc="best", fontsize=8)
    return figure


def errors_over_time(result: MissionResult) -> Figure:
    """Return horizontal errors of dead reckoning, live and final, with the stated 2 sigma."""
    figure, panels = _panels(len(result.vehicles), 3.8)
    for axes, vehicle in zip(panels, result.vehicles, strict=True):
        truth_m = vehicle.truth.position_m
        minutes = vehicle.truth.time_s / 60.0
        tracks = (
            ("dead reckoning", vehicle.dead_reckoning_m, None),
            ("live", vehicle.live_m, vehicle.live_covariance_m2),
            ("final", vehicle.final_m, vehicle.final_covariance_m2),
        )
        for name, track_m, covariance_m2 in tracks:
            error_m = np.hypot(*(track_m - truth_m).T)
            axes.plot(minutes, np.maximum(error_m, 0.05), color=COLOURS[name], lw=1.2, label=name)
            if covariance_m2 is not None and np.isfinite(covariance_m2).any():
                sigma_m = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
                known = np.isfinite(sigma_m)
                axes.plot(
                    minutes[known],
                    np.maximum(2.0 * sigma_m[known], 0.05),
                    color=COLOURS[name],
                    lw=0.8,
                    ls="--",
                    label=f"2 sigma stated, {name}",
                )
        survey_min = result.scenario.survey_s(vehicle.vehicle) / 60.0
        if survey_min < minutes[-1]:
            axes.axvline(survey_min, color="#808080", lw=0.8, ls=":")
            axes.text(survey_min, 0.055, " sonar off", fontsize=8, color="#606060")
        title = vehicle.name.replace("_", " ")
        axes.set(title=title, xlabel="time (min)", ylabel="error (m)", yscale="log")
        axes.grid(alpha=0.25, which="both")
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center", ncols=len(lines), fontsize=8)
    return figure


def maps(result: MissionResult, evaluation: Evaluation) -> Figure:
    """Return the leader's map, shaded, and its difference to the truth map, with the tracks."""
    window = result.site.window
    rows, columns = np.nonzero(np.isfinite(evaluation.map_depth_m))
    figure, panels = _figure(13.0, 5.6, 2)
    if rows.size == 0:
        panels[0].set_title("nothing was mapped")
        return figure
    part = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    west_m = window.east0_m + (columns.min() - 0.5) * window.cell_east_m
    east_m = window.east0_m + (columns.max() + 0.5) * window.cell_east_m
    south_m = window.north0_m + (rows.min() - 0.5) * window.cell_north_m
    north_m = window.north0_m + (rows.max() + 0.5) * window.cell_north_m
    extent = (west_m, east_m, south_m, north_m)
    depth_m = evaluation.map_depth_m[part]
    shown = panels[0].imshow(depth_m, origin="lower", extent=extent, cmap="viridis_r")
    figure.colorbar(shown, ax=panels[0], label="depth in mission datum (m)", shrink=0.8)
    if min(depth_m.shape) > 1:  # one row or column has no slope
        shadow = _shadow(depth_m, window.cell_north_m, window.cell_east_m)
        panels[0].imshow(np.zeros((*shadow.shape, 3)), origin="lower", extent=extent, alpha=shadow)
    for vehicle in result.vehicles:
        panels[0].plot(vehicle.final_m[:, 1], vehicle.final_m[:, 0], color="white", lw=0.7)
    panels[0].set_title("map of the final estimate, final tracks")
    difference_m = depth_m - evaluation.truth_depth_m[part]
    shown = panels[1].imshow(
        difference_m, origin="lower", extent=extent, cmap="RdBu", vmin=-1.0, vmax=1.0
    )
    figure.colorbar(
        shown, ax=panels[1], label="depth of map less truth map (m)", shrink=0.8, extend="both"
    )
    panels[1].set_title("registration error (grey: not in both maps)")
    panels[1].set_facecolor("#c8c8c8")  # no error is nearly white
    panels[1].sharex(panels[0])
    panels[1].sharey(panels[0])
    for axes in panels:
        axes.set(xlabel="east (m)", ylabel="north (m)")
    return figure


def _shadow(depth_m: Array, cell_north_m: float, cell_east_m: float) -> Array:
    """Return how dark each cell is, 0 to 1: flat ground, and what faces the light, is 0."""
    north, east = np.gradient(-depth_m, cell_north_m, cell_east_m)
    light = np.array([0.5, -0.5, 0.7])
    lit = light[2] - light[0] * 5.0 * north - light[1] * 5.0 * east
    lit /= np.sqrt(1.0 + 25.0 * (north**2 + east**2))
    shadow: Array = np.clip(np.nan_to_num(light[2] - lit), 0.0, 1.0)
    return shadow


def closures(result: MissionResult, evaluation: Evaluation) -> Figure:
    """Return active closures on the true tracks, and the errors of all by stage."""
    figure, (plan, strip) = _figure(13.0, 5.6, 2)
    truths = {vehicle.vehicle: vehicle.truth for vehicle in result.vehicles}
    for truth in truths.values():
        plan.plot(truth.east_m, truth.north_m, color="#b0b0b0", lw=0.8)
    active = [judged for judged in evaluation.closures if judged.closure.active_at_end]
    lines = [
        [
            truths[judged.closure.from_vehicle].position_at(judged.closure.from_time_s)[::-1],
            truths[judged.closure.to_vehicle].position_at(judged.closure.to_time_s)[::-1],
        ]
        for judged in active
    ]
    colours = [VALID if judged.is_valid else FALSE for judged in active]
    plan.add_collection(LineCollection(lines, colors=colours, linewidths=1.0))
    plan.set_aspect("equal", adjustable="datalim")
    plan.set(title=f"{len(active)} active closures at the end", xlabel="east (m)")
    plan.set_ylabel("north (m)")
    judgements = ((VALID, f"within {VALID_CLOSURE_M:g} m of the truth"), (FALSE, "farther off"))
    key = [
        Line2D([], [], color=colour, marker="o", ms=4, label=says) for colour, says in judgements
    ]
    figure.legend(handles=key, loc="outside lower center", ncols=len(key), fontsize=8)
    _strip(strip, evaluation.closures)
    return figure


def _strip(axes: Axes, closures: Sequence[JudgedClosure]) -> None:
    groups: dict[str, list[JudgedClosure]] = {stage: [] for stage in (*STAGES, "active")}
    for judged in closures:
        last = "active" if judged.closure.active_at_end else judged.closure.stage
        groups[last].append(judged)
    for k, members in enumerate(groups.values()):
        spread = np.linspace(-0.3, 0.3, max(len(members), 1))[: len(members)]
        errors_m = np.clip([c.error_m for c in members], 0.05, 500.0)
        axes.scatter(
            k + spread, errors_m, s=12, c=[VALID if c.is_valid else FALSE for c in members]
        )
    labels = [f"{name}\n{len(members)}" for name, members in groups.items()]
    axes.set_xticks(range(len(groups)), labels)
    axes.axhline(VALID_CLOSURE_M, color="#808080", lw=0.8, ls="--")
    axes.set(xlim=(-0.5, len(groups) - 0.5), ylabel="error (m)")
    axes.set(yscale="log", ylim=(0.04, 600.0))
    axes.set_title("error of every closure by the last stage it passed")
    axes.grid(alpha=0.25)


def link(deliveries: Sequence[Delivery], duration_s: float) -> Figure:
    """Return the fate of frames over time, one panel for each receiver."""
    receivers = sorted({delivery.destination for delivery in deliveries}) or [0]
    figure, panels = _panels(len(receivers), 3.6)
    width_s = max(60.0, duration_s / 60.0)
    edges_s = np.arange(0.0, duration_s + width_s, width_s)
    for axes, receiver in zip(panels, receivers, strict=True):
        bottom = np.zeros(len(edges_s) - 1)
        for fate, colour in FATES.items():
            times_s = [d.t_tx_s for d in deliveries if d.destination == receiver and d.fate == fate]
            if not times_s:
                continue
            count, _ = np.histogram(times_s, edges_s)
            axes.bar(
                edges_s[:-1] / 60.0,
                count,
                width_s / 60.0,
                bottom,
                align="edge",
                color=colour,
                label=f"{fate}: {len(times_s)}",
            )
            bottom += count
        name = "the leader" if receiver == 0 else f"follower {receiver}"
        axes.set(title=f"frames at {name}", xlabel="time (min)")
        axes.set_ylabel(f"frames in {width_s / 60.0:.3g} min")
        if bottom.any():
            axes.set_ylim(0.0, 1.05 * bottom.max())
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, fontsize=8)
    return figure
