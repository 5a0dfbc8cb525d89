"""The bare arithmetic of a frame in one compiled loop: what no tracker with these formulas can be faster than.

`python benchmarks/lower_bound.py` prints the step of both profiles beside it, the default first.

Everything that has to be found out is given: which pairs lie in the gate, which pairs win. Nothing is allocated,
checked, sorted, searched, assigned, suppressed, pruned or put together. The rest are the numbers themselves: every
object and component is predicted by the unscented transform, every gated pair gets its likelihood and its cost, every
winning pair is updated by the unscented Kalman filter. The formulas are the tracker's, by its own scalar
kernels, inlined into one loop; faster formulas would lower this bound and the tracker's time alike.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from settled import PROFILES, settled
from turns import in_turns

from optipmb.filter.association import associate
from optipmb.filter.class_posterior import UNGROUPED, Groups
from optipmb.filter.hypotheses import local_hypotheses
from optipmb.filter.predict import predict, predict_state
from optipmb.filter.preprocess import preprocess
from optipmb.filter.update import ukf_update, workspace
from optipmb.model.density import Moment, components_in, objects_in
from optipmb.model.table import ClassTable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    import optipmb
    from optipmb.model.table import ClassRow

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]


@numba.njit(error_model="numpy")
def bare(
    mean: Array,
    covariance: Array,
    label: Index,
    dt: float,
    classes: Sequence[ClassRow],
    row: Index,
    measurement: Index,
    existence: Array,
    p_d: Array,
    position: Array,
    won: Index,
    z: Array,
    sigma: Array,
    root: Array,
    points: Array,
    buffers: tuple[Array, ...],
    mean_predicted: Array,
    covariance_predicted: Array,
    cost: Array,
    mean_out: Array,
    covariance_out: Array,
) -> None:
    """Predict all states, weigh all pairs, update all winners; arguments as in the kernels of the tracker."""
    for n in range(mean.shape[0]):
        predict_state(
            mean[n],
            covariance[n],
            dt,
            classes[label[n]],
            (root, points),
            mean_predicted[n],
            covariance_predicted[n],
        )
    for k in range(row.shape[0]):
        n, m = row[k], measurement[k]
        r_xy = classes[label[n]].noise_position ** 2
        s_xx, s_xy = covariance_predicted[n, 0, 0] + r_xy, covariance_predicted[n, 0, 1]
        s_yy = covariance_predicted[n, 1, 1] + r_xy
        determinant = s_xx * s_yy - s_xy * s_xy
        dx, dy = position[m, 0] - mean_predicted[n, 0], position[m, 1] - mean_predicted[n, 1]
        squared = (s_yy * dx * dx - 2.0 * s_xy * dx * dy + s_xx * dy * dy) / determinant
        log_likelihood = -math.log(2.0 * math.pi) - 0.5 * math.log(determinant) - 0.5 * squared
        r, p = existence[n], p_d[n]
        cost[k] = math.log(1.0 - r + r * (1.0 - p)) - math.log(r * p) - log_likelihood
    for k in range(won.shape[0]):
        n, m = won[k, 0], won[k, 1]
        c = label[n]
        ukf_update(
            mean_predicted[n],
            covariance_predicted[n],
            z[m],
            sigma[c],
            buffers,
            mean_out[k],
            covariance_out[k],
        )


def arguments(parameters: optipmb.Parameters, density: optipmb.Density, frame: optipmb.Frame) -> tuple[Any, ...]:
    """Return the arguments of `bare` for one frame: all that the tracker would have to find out, found out."""
    table = ClassTable.of(parameters)
    dt = (frame.stamp_ns - density.stamp_ns) * 1e-9
    predicted, _ = predict(density, Moment(frame.stamp_ns, density.stamp_ns, dt, table.period), table)
    measurements, *_ = preprocess(frame, table)
    old, undetected = predicted.bernoulli, predicted.poisson
    p_d = table["detection"][np.concatenate((old.label, undetected.label))]
    objects, components = objects_in(old.words), components_in(undetected.words)
    groups = Groups(UNGROUPED if predicted.class_probability is None else predicted.class_probability, table.confusion)
    found = local_hypotheses(objects, components, p_d, measurements, groups, table.period, table.classes)
    assigned = associate(found.row, found.measurement, found.detection_cost, found.first_cost, len(old))
    before, waiting = density.bernoulli, density.poisson
    count = len(before) + len(waiting)
    # Predicted rows that a limit has removed are not in a settled scene; the bound counts on it.
    if (len(old), len(undetected)) != (len(before), len(waiting)):
        raise ValueError("a scene without silent objects is wanted")
    winners = np.flatnonzero(assigned >= 0)
    z = np.column_stack([measurements.position, measurements.velocity, measurements.yaw])
    sigma = np.column_stack(
        [
            *(table[f"noise_{name}"] for name in ("position", "position", "velocity", "velocity", "heading")),
            np.zeros(len(table["noise_position"])),  # no covariance of x and y
        ]
    )
    return (
        np.concatenate([before.mean, waiting.mean]),
        np.concatenate([before.covariance, waiting.covariance]),
        np.concatenate([before.label, waiting.label]),
        dt,
        table.classes,
        np.concatenate([found.row, found.component + len(before)]),
        np.concatenate([found.measurement, found.announced]),
        np.concatenate([old.existence, undetected.weight]),
        p_d,
        measurements.position,
        np.column_stack([winners, assigned[winners]]),
        z,
        sigma,
        np.empty((6, 6)),
        np.empty((12, 6)),
        workspace(),
        np.empty((count, 6)),
        np.empty((count, 6, 6)),
        np.empty(len(found.row) + len(found.component)),
        np.empty((winners.size, 6)),
        np.empty((winners.size, 6, 6)),
    )


def main() -> None:
    """Measure in turns, and print a table of medians."""
    sizes, tasks = (10, 100, 800), dict[str, Any]()
    for objects in sizes:
        for profile in PROFILES:
            tracker, density, frame = settled(objects, profile=profile)
            given = arguments(tracker.parameters, density, frame)
            tasks[f"{profile} {objects}"] = lambda t=tracker, d=density, f=frame: t.step(d, f)
            tasks[f"{profile} {objects} bare"] = lambda a=given: bare(*a)
    times = {name: float(np.median(spent)) for name, spent in in_turns(tasks).items()}
    default, tuned = PROFILES
    print(f"| objects | `{default}` ms | ratio to bare | `{tuned}` ms | ratio to bare | `{default}` to `{tuned}` |")
    print("| ---: " * 6 + "|")
    for objects in sizes:
        row = [f"{objects}"]
        for profile in PROFILES:
            step = times[f"{profile} {objects}"]
            row += [f"{step:.4f}", f"{step / times[f'{profile} {objects} bare']:.2f}"]
        row.append(f"{times[f'{default} {objects}'] / times[f'{tuned} {objects}']:.2f}")
        print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
