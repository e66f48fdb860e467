"""What came out of a replay, in words: for people, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from facet.commands.terminal import InputError, err, out, table

if TYPE_CHECKING:
    from facet.commands.replay import Replayed
    from facet.export.model import Model

NO_SCAN_CURE = "`facet info` lists what is"
MOST = 0.5  # of the points: a wrong unit leaves out about all


def print_result(result: Replayed, model: Model) -> None:
    """What the replay of a log with scans gave, what was lost, and the digests."""
    say_losses(result)
    rejected = {
        name.removeprefix("points_rejected."): num
        for name, num in result.account.counters().items()
        if name.startswith("points_rejected.") and "[" not in name
    }
    if sum(rejected.values()) > MOST * result.account["points_in"]:
        reasons = ", ".join(f"{num:,} {name}" for name, num in rejected.items())
        err.print(f"most points were left out: {reasons}; are they in metres?")
    if "no_pose" in result.left_out:
        err.print(
            "no_pose: no transforms lead from these scans to the map's frame; --frame names "
            "another, `facet info` shows whether the log has transforms"
        )
    table("map", ("what", "value"), summary(model, result.wall_s, result.log_s))
    out.print(f"state   {model['digest']['state']}")
    out.print(f"derived {model['digest']['derived']}")
    num, applied = result.num_scans, result.account["applied"]
    out.print(
        f"mapped {applied:,} of {num:,} scans recorded ({100.0 * applied / num:.1f} %), "
        f"missing from the log {result.num_missing:,}"
    )


def say_losses(result: Replayed) -> None:
    """What of the log could not be read, and what was left out."""
    for path, damage in result.recording.damage.items():
        for note in damage.notes:
            err.print(f"{path}: {note}")
    if result.num_left_out:
        reasons = ", ".join(f"{num:,} {name}" for name, num in result.left_out.items())
        err.print(f"left out: {reasons}")


def summary(model: Model, wall_s: float, log_s: float) -> list[tuple[str, Any]]:
    """The figures of a map, one a row."""
    counts, planes = model["counts"], model["planes"]
    classes = [plane["class"] for plane in planes]
    surfaces = [surface for plane in planes for surface in plane["surfaces"]]
    holes = [hole["kind"] for surface in surfaces for hole in surface["holes"]]
    by_class = ", ".join(f"{classes.count(c)} {c}" for c in sorted(set(classes)))
    voxels = counts["voxels"]
    return [
        ("scans", counts["scans"]),
        ("points", counts["points_stored"]),
        ("voxels", voxels),
        ("planes", f"{len(planes)} ({by_class})" if planes else "0"),
        ("surfaces", len(surfaces)),
        ("area", f"{sum(s['area_m2'] for s in surfaces):,.1f} m²"),
        ("openings", holes.count("opening")),
        ("unobserved holes", holes.count("unobserved")),
        ("discarded", f"{100.0 * counts['discarded'] / voxels if voxels else 0.0:.1f} % of voxels"),
        ("noise", f"{1e3 * model['noise']['sigma_n_m']:.1f} mm"),
        ("wall time", f"{wall_s:.1f} s"),
        ("real-time factor", f"{log_s / wall_s:.1f}" if wall_s > 0 and log_s > 0 else "not known"),
    ]


def require_scans(result: Replayed) -> None:
    """Raises InputError for a log without a single scan."""
    if not result.account["applied"]:
        (first, *_) = result.recording.paths
        raise InputError(f"{first}: no scan in it that could be mapped; {NO_SCAN_CURE}")
