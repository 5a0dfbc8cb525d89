"""Textbook formulas, written out one by one: what the tracker's kernels are compared with.

Conventions are the tracker's: motion state [x, y, v, phi, omega, a] in the world frame, metres, seconds, radians;
auxiliary state [length, width, height, z]; stamps in nanoseconds. The paper's names of quantities are kept, so that a
formula can be proof-read against it. Nothing here imports the tracker.
"""
# ruff: noqa: N803, N806 - P, S, K, R, C and the like are the names that the formulas of the paper use

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ORDER = [2, 3, 4, 5, 0, 1]  # the order of the state for the matrix square root: position last


@dataclass
class Measurement:
    """One detection that passed the preprocessing: z = [z_M, z_A, z_c, z_s]."""

    xy: Array
    velocity: Array | None
    yaw: float
    auxiliary: Array
    label: int
    score: float
    source: int
    spacing: float = math.inf
    clutter: float = 0.0


def wrap(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def fold(angle: float) -> float:
    """The same angle modulo pi in (-pi/2, pi/2]."""
    return math.pi / 2 - (math.pi / 2 - angle) % math.pi


def periods(a_ns: int, b_ns: int, nominal: float) -> int:
    """Whole nominal periods from stamp a to stamp b."""
    return math.floor((b_ns - a_ns) * 1e-9 / nominal + 0.5)


@lru_cache(maxsize=64)
def _nodes(count: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def ctra(x: Array, dt: float, tau: float = math.inf) -> Array:
    """Gamma_CTRA: the integral of constant omega and of a, or of a exp(-t / tau), by Gauss-Legendre quadrature.

    Where a decays, it brakes with at most 3 |v| / tau and to a standstill, and speeds up with at most 5 |v| / tau.
    """
    px, py, v, phi, omega, a = x
    if tau < math.inf:
        most = min(3.0, 1 / (1 - math.exp(-dt / tau))) if v * a < 0 else 5.0
        a = math.copysign(min(abs(a), most * abs(v) / tau), a)
    nodes, weights = _nodes(24 + math.ceil((abs(omega) + 1 / tau) * dt))
    t = 0.5 * dt * (nodes + 1.0)

    def speed(t: Any) -> Any:
        return v + (a * t if tau == math.inf else a * tau * (1 - np.exp(-t / tau)))

    passed = 0.5 * dt * weights * speed(t)
    px += np.dot(passed, np.cos(phi + omega * t))
    py += np.dot(passed, np.sin(phi + omega * t))
    return np.array([px, py, speed(dt), phi + omega * dt, omega, a * math.exp(-dt / tau)])


def constant_velocity(x: Array, dt: float) -> Array:
    """Speed and heading stay; turn rate and acceleration play no part."""
    px, py, v, phi, omega, a = x
    return np.array([px + v * math.cos(phi) * dt, py + v * math.sin(phi) * dt, v, phi, omega, a])


def sigma_points(m: Array, P: Array) -> list[Array]:
    """The symmetric set m +- sqrt(n) L_i, equal weights; L: Cholesky factor of the state with position last."""
    n = len(m)
    L = np.zeros((n, n))
    L[ORDER] = np.linalg.cholesky(P[np.ix_(ORDER, ORDER)])
    return [m + sign * math.sqrt(n) * L[:, i] for sign in (1.0, -1.0) for i in range(n)]


def predict(
    m: Array, P: Array, Q: Array, dt: float, tau: float = math.inf, *, straight: bool = False
) -> tuple[Array, Array]:
    """Eq. (Motion Predict): (m+, P+) by the unscented transform through the motion model, Q = diag(q)^2 dt."""
    if dt == 0.0:
        return m.copy(), P.copy()
    if straight:
        m, Q = np.array([*m[:4], 0.0, 0.0]), np.diag([*np.diag(Q)[:4], 0.0, 0.0])
    points = [constant_velocity(x, dt) if straight else ctra(x, dt, tau) for x in sigma_points(m, P)]
    mean = np.mean(points, axis=0)
    covariance = np.mean([np.outer(x - mean, x - mean) for x in points], axis=0) + Q * dt
    mean[3] = wrap(mean[3])
    return mean, 0.5 * (covariance + covariance.T)


def smooth(means: Array, covariances: Array, t: Array, Q: Array, tau: float) -> tuple[Array, Array]:
    """The unscented Rauch-Tung-Striebel smoother (Särkkä 2008) over one track: (T, 6), (T, 6, 6), times (T,) in s."""
    m_s, P_s = [means[-1].copy()], [covariances[-1].copy()]
    for m, P, dt in reversed(list(zip(means[:-1], covariances[:-1], np.diff(t), strict=True))):
        m_p, P_p = predict(m, P, Q, dt, tau)
        D = np.zeros_like(P)
        points = sigma_points(m, P)
        for x in points:
            moved = ctra(x, dt, tau) - m_p
            moved[3] = wrap(moved[3])
            D += np.outer(x - m, moved) / len(points)
        G = D @ np.linalg.inv(P_p)
        change = m_s[0] - m_p
        change[3] = wrap(change[3])
        m_s.insert(0, m + G @ change)
        P_s.insert(0, P + G @ (P_s[0] - P_p) @ G.T)
    return np.array(m_s), np.array(P_s)


def measure(x: Array, *, with_velocity: bool) -> Array:
    """Eq. (Single Object Measurement Model): H(x) = [x, y, v cos phi, v sin phi, phi]."""
    px, py, v, phi = x[:4]
    return np.array([px, py, v * np.cos(phi), v * np.sin(phi), phi] if with_velocity else [px, py, phi])


def believed(m: Array, P: Array, z: Measurement, c: Any) -> Array | None:
    """The velocity of a measurement, None where it or the position is beyond the velocity gate."""
    if z.velocity is None or not c.velocity_gate:
        return z.velocity
    noise, forward = c.measurement_noise, np.array([math.cos(m[3]), math.sin(m[3])])
    axes = np.array([forward, [-forward[1], forward[0]]])
    place, speed = z.xy - m[:2], axes @ z.velocity - [m[2], 0]
    S = P[:2, :2] + noise.position**2 * np.eye(2)
    S_v = np.diag([P[2, 2], m[2] ** 2 * P[3, 3]]) + noise.velocity**2 * np.eye(2)
    far = max(place @ np.linalg.inv(S) @ place, speed @ np.linalg.inv(S_v) @ speed)
    return None if far > c.velocity_gate**2 else z.velocity


def ukf_update(m: Array, P: Array, z: Measurement, c: Any) -> tuple[Array, Array]:
    """Eq. (UKF Update) with the parameters `c` of the class."""
    velocity = believed(m, P, z, c)
    known = velocity is not None
    points = sigma_points(m, P)
    images = [measure(x, with_velocity=known) for x in points]
    z_hat = np.mean(images, axis=0)
    noise = c.measurement_noise
    deviations = [noise.position] * 2 + ([noise.velocity] * 2 if known else []) + [noise.heading]
    S = np.mean([np.outer(y - z_hat, y - z_hat) for y in images], axis=0) + np.diag(np.square(deviations))
    C = np.mean([np.outer(x - m, y - z_hat) for x, y in zip(points, images, strict=True)], axis=0)
    nu = np.concatenate([z.xy, [] if velocity is None else velocity, [z.yaw]]) - z_hat
    nu[-1] = fold(nu[-1])
    K = C @ np.linalg.inv(S)
    mean = m + K @ nu
    mean[3] = wrap(mean[3])
    covariance = P - K @ S @ K.T
    return mean, 0.5 * (covariance + covariance.T)


def log_likelihood(xy: Array, m: Array, P: Array, position: float) -> float:
    """Logarithm of N(z_xy; z_hat, S) with eq. (Predicted Measurement): z_hat = H_xy m+, S = H_xy P+ H_xy' + R_xy."""
    H = np.eye(2, 6)
    S = H @ P @ H.T + position**2 * np.eye(2)
    d = xy - H @ m
    return float(-0.5 * d @ np.linalg.inv(S) @ d - 0.5 * math.log(np.linalg.det(2 * math.pi * S)))


def moment_match(weights: list[float], parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Mean and covariance of a Gaussian mixture; headings relative to the heaviest component, the first one on ties."""
    reference = parts[weights.index(max(weights))][0]
    unrolled = []
    for mean, _ in parts:
        x = mean.copy()
        x[3] = reference[3] + wrap(mean[3] - reference[3])
        unrolled.append(x)
    m = np.sum([w * x for w, x in zip(weights, unrolled, strict=True)], axis=0)
    spread = [P + np.outer(x - m, x - m) for x, (_, P) in zip(unrolled, parts, strict=True)]
    P = np.sum([w * part for w, part in zip(weights, spread, strict=True)], axis=0)
    m[3] = wrap(m[3])
    return m, 0.5 * (P + P.T)


def corners(x: float, y: float, length: float, width: float, yaw: float) -> list[Array]:
    """Corners of a rectangle on the ground plane, counter-clockwise."""
    forward = np.array([math.cos(yaw), math.sin(yaw)]) * length / 2
    left = np.array([-math.sin(yaw), math.cos(yaw)]) * width / 2
    return [np.array([x, y]) + i * forward + j * left for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]


def _area(polygon: list[Array]) -> float:
    if not polygon:
        return 0.0
    origin = polygon[0]
    pairs = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return 0.5 * sum(float((p - origin)[0] * (q - origin)[1] - (p - origin)[1] * (q - origin)[0]) for p, q in pairs)


def iou(box_a: Array, box_b: Array) -> float:
    """Intersection over union of two boxes [x, y, length, width, yaw], by Sutherland-Hodgman clipping."""
    polygon = corners(*box_a)
    clip = corners(*box_b)
    for a, b in zip(clip, clip[1:] + clip[:1], strict=True):
        edge, kept = b - a, []
        side = [float(edge[0] * (p - a)[1] - edge[1] * (p - a)[0]) for p in polygon]
        for i, p in enumerate(polygon):
            j = (i + 1) % len(polygon)
            if side[i] >= 0:
                kept.append(p)
            if side[i] * side[j] < 0:
                kept.append(p + (polygon[j] - p) * side[i] / (side[i] - side[j]))
        polygon = kept
    common = _area(polygon)
    return float(common / (box_a[2] * box_a[3] + box_b[2] * box_b[3] - common))


def count_inside(world: Array, xy: Array, yaw: float, auxiliary: Array) -> int:
    """Points in a box, faces included; `world` holds world points in rows."""
    length, width, height, z = auxiliary
    offsets = world - np.array([xy[0], xy[1], z])
    close = np.all(np.abs(offsets) <= length + width + height, axis=1)  # only to be spared the far ones
    dx, dy, dz = offsets[close].T
    along = math.cos(yaw) * dx + math.sin(yaw) * dy
    across = -math.sin(yaw) * dx + math.cos(yaw) * dy
    inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2) & (np.abs(dz) <= height / 2)
    return int(inside.sum())


def birth(z: Measurement, c: Any) -> tuple[Array, Array]:
    """The newborn Gaussian N(m0, P0) of a measurement."""
    phi, v, spread = z.yaw, 0.0, c.birth.unknown_speed
    if z.velocity is not None:
        spread = c.birth.speed
        v = math.hypot(*z.velocity)
        if v > 0 and v >= c.birth_heading_speed:
            phi = math.atan2(z.velocity[1], z.velocity[0])
        else:
            v = z.velocity[0] * math.cos(z.yaw) + z.velocity[1] * math.sin(z.yaw)
    b = c.birth
    deviations = [b.position, b.position, spread, b.heading, b.turn_rate, b.acceleration]
    return np.array([*z.xy, v, wrap(phi), 0.0, 0.0]), np.diag(np.square(deviations))


def follow_evidence(c: Any, evidence: float, since: float, score: float | None) -> float:
    """Mean log odds of the latest detections with fading weights; `score` is None where the object was missed."""
    if c.calibration is None:
        return 0.0
    if score is None:
        odds = -c.calibration.missed
    else:
        odds = 14.0 if score == 1.0 else max(-14.0, min(14.0, math.log(score / (1.0 - score))))
    kept = c.calibration.memory**since
    return float(kept * evidence + (1.0 - kept) * odds)


T = np.diag([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])  # the motion with the opposite heading, in addition to the pi on phi


def follow_sign(c: Any, odds: float, since: float, z: Measurement, m: Array, P: Array) -> tuple[float, Array, Array]:
    """Log odds that the heading is right after a detection, and the state, turned around where they fall below zero."""
    known = c.heading_sign
    if known is None:
        return 0.0, m, P
    latest = known.detection * z.score * math.cos(z.yaw - m[3])
    if abs(m[2]) >= known.speed + 2 * math.sqrt(P[2, 2]):
        latest += known.motion * math.copysign(1.0, m[2])
    kept = known.memory**since
    odds = kept * odds + (1 - kept) / (1 - known.memory) * latest
    if odds >= 0:
        return odds, m, P
    turned = T @ m
    turned[3] = wrap(m[3] + math.pi)
    return -odds, turned, T @ P @ T


def confidence(c: Any, odds: float) -> tuple[float, float]:
    """Probability that the heading is right, and the variance that the doubt adds."""
    p = 1.0 if c.heading_sign is None else 1 / (1 + math.exp(-odds))
    return p, max(p * (1 - p) - 0.025 * 0.975, 0.0) * math.pi**2


def report(c: Any, z: Measurement | None, m: Array, P: Array) -> tuple[Array, Array]:
    """The reported state: its box updated once more with the noise that is left between R and R'."""
    if z is None or c.reported_noise is None:
        return m, P
    less, noise = c.reported_noise, c.measurement_noise
    names = ["position", "position", "heading"]
    used = [i for i, name in enumerate(names) if getattr(less, name) < getattr(noise, name)]
    left = [1 / (getattr(less, names[i]) ** -2 - getattr(noise, names[i]) ** -2) for i in used]
    H = np.eye(6)[[[0, 1, 3][i] for i in used]]
    nu = np.array([z.xy[0] - m[0], z.xy[1] - m[1], fold(z.yaw - m[3])])[used]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(left))
    K[[2, 4, 5]] = 0.0  # nothing of it for speed, turn rate and acceleration
    mean = m + K @ nu
    mean[3] = wrap(mean[3])
    rest = np.eye(6) - K @ H
    return mean, rest @ P @ rest.T + K @ np.diag(left) @ K.T


def with_history(history: Any, existence: float, b: Any, age: float, speed: float) -> float:
    """Existence of a track by all of its frames, at a recall of one."""
    odds = float(np.clip(np.log(existence) - np.log1p(-existence), -14.0, 14.0))
    odds = history.offset + history.existence * odds + history.duration * math.log1p(age)
    odds += history.share * min((b.hits - 1) / max(b.looks - 1, 1), 1.2) + history.speed * min(speed, 2.0)
    return 1.0 / (1.0 + math.exp(-odds))


def calibrate(c: Any, b: Any, m: Array, P: Array) -> tuple[float, float, Array]:
    """Reported existence, score and covariance of a track: curves over the evidence, level at their ends."""
    if c.calibration is None:
        return b.existence, b.score, P
    known = c.calibration
    existence, along, across = (
        float(np.interp(b.evidence, known.evidence, column)) for column in (known.existence, known.along, known.across)
    )
    turn = np.array([[math.cos(m[3]), -math.sin(m[3])], [math.sin(m[3]), math.cos(m[3])]])
    factors = np.array([1.0, 1.0, known.speed, 1.0, known.turn_rate, 1.0])
    covariance = P * np.outer(factors, factors)
    covariance[:2, :2] += turn @ np.diag([along**2, across**2]) @ turn.T
    w = known.score_of_evidence
    return existence, (1 - w) * b.score + w * (b.evidence + 14.0) / 28.0, covariance
