"""Base to base on the source's two experiments."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.harness import Row, Table, markdown
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.cells.stand import Stand, TouchedPoints, compare_distances, cylinder_points, fit_stand, project

TRUE = {1: [4.0, -1.0, 1.0], 2: [6.0, -4.0, 1.0]}
JOINTS = {1: (0.6283, 0.4488), 2: (1.0472, 0.6283)}
SLIDE = {1: 3.8822, 2: 5.9093}
ANGLE = {1: [0.6826, 0.7897], 2: [1.1305, 1.1772]}
LENGTH = {1: [4.0, 4.4084], 2: [5.0, 5.5555]}
PUBLISHED = {
    (1, 0.1): (1.0e-4, 1.4e-4),
    (1, 0.5): (1.7e-4, 2.2e-4),
    (2, 0.1): (1.4e-4, 1.4e-4),
    (2, 0.5): (5.4e-4, 3.6e-4),
}
# Table 3 of the source, experiment 1: P1, P2, R1, R2.
TABLE_3 = {
    0.1: [[1.1731, 0.8523, 1.3], [1.1731, -0.8523, 1.3], [0.6307, -0.3037, 0.3], [0.6306, 0.3037, 0.3]],
    0.5: [[1.1728, 0.8520, 1.3002], [1.1730, -0.8524, 1.3002], [0.6307, -0.3037, 0.3], [0.6307, 0.3037, 0.3]],
}
# Change of radius and height per rad of joints 2 and 5 of the main robot, from the noisy angles of the source's
# table 2 and the positions of its table 3; the arm's dimensions are not published.
LEVERS = np.array([[0.76, -0.51], [-0.80, -0.13]])


def exact_stand(experiment: int, joints: tuple[float, float]) -> Stand:
    """Return the true stand: T and joint angles exact, rod readings computed, so that nothing contradicts anything."""
    (p, r), t = joints, np.array(TRUE[experiment])
    P = cylinder_points(np.array([p, -p]), np.full(2, 1.45), np.full(2, 1.3))
    R = cylinder_points(np.array([-r, r]), np.full(2, 0.7), np.full(2, 0.3))
    R1 = np.stack([R[:, 1], -R[:, 0], R[:, 2]], -1) + t
    pivot = P[1] - [0, SLIDE[experiment], 0]
    arm = R1 - pivot
    return stand_of(P, R, SLIDE[experiment], np.arctan2(arm[:, 0], arm[:, 1]), np.linalg.norm(arm, axis=1))


def stand_of(P: Array, R: Array, slide: float, angle: Array, length: Array) -> Stand:
    """Return a stand of touched points P, R (2, 3) and the readings of its rod."""
    touched = np.tile(np.eye(3) * 1e-8, (2, 1, 1))
    return Stand(
        length_unit="m",
        rail=TouchedPoints(("P1", "P2"), P, touched),
        rail_slide=np.array([np.nan, 0.0]),
        rod=TouchedPoints(("R1", "R2"), R, touched),
        slide=np.full(2, slide),
        angle=np.asarray(angle),
        length=np.asarray(length),
        turn=1.0,
        sigma_slide=1e-6,
        sigma_angle=1e-6,
        sigma_length=1e-6,
        sigma_level_stand=1e-4,
        sigma_level_base=1e-4,
    )


def noisy(stand: Stand, joints: tuple[float, float], noise: float, rng: np.random.Generator) -> Stand:
    """The source's noise, formula 12, on every joint angle; angles of zero stay exact."""

    def u(t):
        return t + noise * 1e-3 * t * (rng.random(np.shape(t)) - 0.5)

    p, r = joints
    q25 = u(np.full((2, 2), np.pi / 2)) - np.pi / 2
    dr, dz = LEVERS @ q25
    P = cylinder_points(u(np.array([p, -p])), 1.45 + dr, 1.3 + dz)
    R = cylinder_points(u(np.array([-r, r])), np.full(2, 0.7), np.full(2, 0.3))
    spread = noise * 1e-3 / np.sqrt(12)
    rail = replace(stand.rail, points=P, covariance=covariance(P, p * spread, spread * np.pi / 2))
    rod = replace(stand.rod, points=R, covariance=covariance(R, r * spread, 1e-6))
    return replace(stand, rail=rail, rod=rod)


def covariance(points: Array, sigma_joint1: float, sigma_other: float) -> Array:
    """(N, 3, 3): tangent by joint 1, radius and height by the other joints."""
    radius = np.hypot(points[:, 0], points[:, 1])
    radial = np.stack([points[:, 0] / radius, points[:, 1] / radius, 0 * radius], -1)
    axes = np.stack(
        [np.stack([-radial[:, 1], radial[:, 0], 0 * radius], -1), radial, np.tile([0.0, 0, 1], (len(points), 1))], -1
    )
    sigma = np.stack([radius * sigma_joint1, 0 * radius + sigma_other, 0 * radius + sigma_other], -1)
    return np.einsum("nij,nj,nkj->nik", axes, sigma**2, axes)


def errors(T: Array, experiment: int) -> tuple[float, float]:
    """Rotation (rad) and translation (m) error against the truth, −90° about z."""
    truth = frames.exp(np.array([0, 0, -np.pi / 2, 0, 0, 0]))
    truth[:3, 3] = TRUE[experiment]
    return float(frames.angle_between(T, truth)), float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def jobs(seeds: range) -> Iterator[Row]:
    """The source's noise at both sizes; as many draws as there are seeds, from one generator."""
    for experiment, noise in PUBLISHED:
        yield {"experiment": experiment, "noise": noise, "draws": len(seeds)}


def trial(job: Row) -> Row:
    """Errors (draws, 2) of both solutions under the source's noise."""
    experiment, noise = job["experiment"], job["noise"]
    # Experiment 2's own joint angles contradict its rod; with those of experiment 1 everything closes.
    stand, rng = exact_stand(experiment, JOINTS[1]), np.random.default_rng(int(1000 * noise) + experiment)
    stands = [noisy(stand, JOINTS[1], noise, rng) for _ in range(job["draws"])]
    return {
        "projection": [errors(project(s).T_base1_base2, experiment) for s in stands],
        "least squares": [errors(fit_stand(s).T_base1_base2, experiment) for s in stands],
    }


def summary(rows: list[Row]) -> list[str]:
    """Errors under noise; the source's noisy positions; the distance that rod and joints contradict."""
    lines = []
    for row in rows:
        published = PUBLISHED[row["experiment"], row["noise"]]
        for name in ("projection", "least squares"):
            off = np.array(row[name])
            low, median, high = 1e6 * np.quantile(off, [0.025, 0.5, 0.975], axis=0)
            rms, asked = 1e6 * np.sqrt((off**2).mean(0)), 1e6 * np.array(published)
            figures = [f"{a:.0f} / {b:.0f}" for a, b in (rms, median, asked)]
            figures.insert(2, " / ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True)))
            below = " / ".join(f"{share:.0%}" for share in (off <= published).mean(axis=0))
            lines.append([row["experiment"], row["noise"], name, *figures, below])
    head = "experiment | λ | solution | rms | median | 95 % of draws between | published, one draw | draws below that"
    return [
        f"Errors under the source's noise, {rows[0]['draws']} draws; rotation in µrad / translation in µm.",
        "",
        *markdown(head, lines),
        "",
        "The source's noisy positions of experiment 1 (table 3, rounded to 0.1 mm) and its rod readings:",
        "",
        *markdown("λ | solution | rotation / rad | translation / m | published", _table_3()),
        "",
        "Distance R1 to R2 with the rod readings and joint angles as printed:",
        "",
        *markdown(
            "rod of | joints of | by rod / m | by joints / m | difference / m | translation found",
            (_closing(rod, joints) for rod, joints in ((1, 1), (2, 2), (2, 1))),
        ),
    ]


def _table_3() -> Iterator[list[object]]:
    for noise, points in TABLE_3.items():
        stand = stand_of(np.array(points[:2]), np.array(points[2:]), SLIDE[1], np.array(ANGLE[1]), np.array(LENGTH[1]))
        published = "{:.5f} / {:.5f}".format(*PUBLISHED[1, noise])
        for name, solution in (("projection", project(stand)), ("least squares", fit_stand(stand))):
            rotation, translation = errors(solution.T_base1_base2, 1)
            yield [noise, name, f"{rotation:.5f}", f"{translation:.5f}", published]


def _closing(rod: int, joints: int) -> list[object]:
    p, r = JOINTS[joints]
    P = cylinder_points(np.array([p, -p]), np.full(2, 1.45), np.full(2, 1.3))
    R = cylinder_points(np.array([-r, r]), np.full(2, 0.7), np.full(2, 0.3))
    stand = stand_of(P, R, SLIDE[rod], np.array(ANGLE[rod]), np.array(LENGTH[rod]))
    c = compare_distances(stand)[0]
    refused = abs(c.difference) > 1e-3
    place = "refused" if refused else np.array2string(fit_stand(stand).T_base1_base2[:3, 3], precision=4)
    return [rod, joints, f"{c.by_stand:.4f}", f"{c.by_robot:.4f}", f"{c.difference:+.4f}", place]


TABLE = Table(jobs, trial, summary, range(1000), page="base-to-base", block="tables")
