"""Adaptive Monte Carlo localisation: where in a known map the robot is, from odometry and laser.

Tracking is a particle filter: the odometry motion model with noise, the likelihood field, low-variance resampling with
as many particles as KLD sampling asks for, and random particles where the scan becomes unlikely (augmented MCL). Two
things make it robust. Odometry is corrected by aligning scans with each other first, so it goes on through places that
the map lacks. And where the pose is not known, or no longer explains what is seen, hypotheses come from a search of the
whole map with the scans of the last metres put together.

It is sure only while its particles are in one place and the map explains the scans from there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.global_search import Hypothesis, SearchParams, judge, search
from skytether_services.navigation.likelihood_field import LikelihoodField, explain, score_poses
from skytether_services.navigation.motion_model import OdometryNoise, between, compose, move_particles, wrap
from skytether_services.navigation.particles import Cluster, bin_keys, heaviest_cluster, kld_count, low_variance_sample
from skytether_services.navigation.scan_odometry import ScanOdometry, ScanOdometryParams

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalisationParams:
    """How the robot is localised.

    Attributes:
        min_particles: As few are enough where all are in one place.
        max_particles: As many at most.
        kld_error: Largest Kullback-Leibler distance of the particles from the posterior.
        kld_quantile: Of the normal distribution, for the probability of that (2.33: 99 percent).
        bin_size: Side of the bins that are counted for it [m].
        bin_turn: And their width in heading [rad].
        beams: As many of a scan's beams are compared with the map.
        independent_beams: They count as much as so many independent ones: neighbours see the same wall, and err alike.
        max_beam: Longer beams are left out [m].
        update_distance: The map is asked after so much motion [m].
        update_turn: Or after so much turning [rad].
        alpha_slow: Weight of a new scan in the slow mean of its likelihood.
        alpha_fast: And in the fast one. Where the fast mean falls below the slow one, random particles come in; 0 for
            both switches them off.
        random_share: They are not more than this share.
        cluster_radius: Particles as near as this are in the same place [m].
        cluster_turn: And in heading [rad].
        wheels: How wheel odometry errs.
        corrected: How odometry errs that the laser has corrected.
        scans: How scans are aligned with each other.
        search: How the map is searched.
        search_distance: While it is not sure, the map is searched each time after so much motion [m].
        sure_share: It becomes sure where the map explains this share of the beams.
        sure_known: And has something to say about this share of them.
        sure_lead: And every other place explains less, by so much of the score.
        sure_distance: After so much motion within one place [m].
        doubt_share: It doubts where the map explains less than this share.
        doubt_known: While the map has something to say about at least this share of the beams.
        doubt_distance: For so much motion on end [m].
        lost_deviation: Standard deviation of the position from which on it is not sure [m].
    """

    min_particles: int = 500
    max_particles: int = 2000
    kld_error: float = 0.05
    kld_quantile: float = 2.33
    bin_size: float = 0.25
    bin_turn: float = math.radians(10)
    beams: int = 90
    independent_beams: float = 18.0
    max_beam: float = 25.0
    update_distance: float = 0.05
    update_turn: float = 0.03
    alpha_slow: float = 0.01
    alpha_fast: float = 0.2
    random_share: float = 0.2
    cluster_radius: float = 0.6
    cluster_turn: float = math.radians(30)
    wheels: OdometryNoise = field(default_factory=OdometryNoise)
    corrected: OdometryNoise = field(
        default_factory=lambda: OdometryNoise(
            alpha1=0.004, alpha2=0.002, alpha3=0.01, alpha4=0.001, floor_position=0.008, floor_heading=0.004
        )
    )
    scans: ScanOdometryParams = field(default_factory=ScanOdometryParams)
    search: SearchParams = field(default_factory=SearchParams)
    search_distance: float = 0.5
    sure_share: float = 0.7
    sure_known: float = 0.6
    sure_lead: float = 0.25
    sure_distance: float = 1.0
    doubt_share: float = 0.45
    doubt_known: float = 0.4
    doubt_distance: float = 0.5
    lost_deviation: float = 0.5


@dataclass(frozen=True)
class Estimate:
    """Where the robot is.

    Attributes:
        pose: x [m], y [m], heading [rad], map frame: the mean of the particles in the likeliest place.
        covariance: Of it, 3 by 3 [m², rad²].
        sure: Whether to act on it.
        weight: Share of the particles that are in that place.
        explained: Share of the beams that the map explains from there, of those about which it says something.
        known: Share of the beams about which it does.
        searched: Whether the whole map was searched in this update.
    """

    pose: Array
    covariance: Array
    sure: bool
    weight: float
    explained: float
    known: float
    searched: bool


class Localisation:
    """Adaptive Monte Carlo localisation in one map.

    Attributes:
        particles: n by 3: x [m], y [m], heading [rad], map frame.
        weights: Of them; sum to 1.
    """

    def __init__(
        self, field: LikelihoodField, random: np.random.Generator, params: LocalisationParams | None = None
    ) -> None:
        if len(field.free) == 0:
            raise ValueError("the map has no free cell; the robot could be nowhere")
        self.params = params or LocalisationParams()
        self._field = field
        self._random = random
        self._odometry = ScanOdometry(self.params.scans, self.params.wheels)
        self._sure = False
        self._since_asked = np.zeros(3)
        self._since_search = math.inf
        self._agreed = 0.0
        self._doubted = 0.0
        self._regained = 0.0
        self._leader: Array | None = None
        self._slow = self._fast = 0.0
        self._trust = 1.0
        self._believed = False
        self._estimate: Estimate | None = None
        self.particles: Array = np.zeros((0, 3))
        self.weights: Array = np.zeros(0)
        self.forget()

    def forget(self) -> None:
        """Begin anew without any pose: the robot may be anywhere in the map."""
        self.particles = self._anywhere(self.params.max_particles)
        self.weights = np.full(len(self.particles), 1 / len(self.particles))
        self._odometry.keys.clear()
        self._believed = False
        self._trust = 1.0
        self._unsure()

    def place(self, pose: Array, covariance: Array) -> None:
        """Begin anew at a pose that somebody gave; it is believed until the scans say otherwise.

        Args:
            pose: x [m], y [m], heading [rad], map frame.
            covariance: Of it, 3 by 3 [m², rad²].
        """
        self.particles = self._around(pose, covariance, self.params.max_particles)
        self.weights = np.full(len(self.particles), 1 / len(self.particles))
        self._sure = self._believed = True
        self._trust = 1.0
        self._doubted = 0.0
        self._slow = self._fast = 0.0
        self._estimate = None

    def update(self, step: Array, points: Array, origin: Array | None = None) -> Estimate:
        """Take what odometry and laser say.

        Args:
            step: What odometry says of the motion since the last update, in the robot's frame before it: x [m], y [m],
                heading [rad].
            points: n by 2: ends of the beams that met something, in the robot's frame [m]. May be none.
            origin: x, y of the laser in the robot's frame [m]; None: as the robot's.
        """
        params = self.params
        origin = np.zeros(2) if origin is None else origin
        if not np.isfinite(step).all():
            step = np.zeros(3)
        points = points[np.isfinite(points).all(axis=1)]
        points = points[np.hypot(points[:, 0] - origin[0], points[:, 1] - origin[1]) <= params.max_beam]
        moved, continues = self._odometry.update(step, points)
        noise = params.corrected if continues and len(points) else params.wheels
        self.particles = move_particles(self.particles, moved, noise, self._random)
        travelled = math.hypot(moved[0], moved[1]) + 0.3 * abs(moved[2])
        self._since_search += travelled
        self._since_asked = compose(self._since_asked, moved)
        if self._leader is not None:
            self._leader = compose(self._leader, moved)
        away = self._since_asked
        still = math.hypot(away[0], away[1]) < params.update_distance and abs(away[2]) < params.update_turn
        if still and self._estimate is not None and continues:
            return self._carried(moved)
        self._since_asked = np.zeros(3)
        if len(points):
            self._weigh(self._thin(points, params.beams))
        cluster = heaviest_cluster(self.particles, self.weights, params.cluster_radius, params.cluster_turn)
        seen = explain(self._field, cluster.mean, np.broadcast_to(origin, points.shape), points)
        self._trust = max(0.1, seen.share * seen.known)
        self._judge_tracking(cluster, seen.share, seen.known, travelled, continues)
        searched = False
        if not self._sure and len(points) and self._since_search >= params.search_distance:
            searched = True
            self._search(origin, cluster)
            cluster = heaviest_cluster(self.particles, self.weights, params.cluster_radius, params.cluster_turn)
        self._resample()
        self._estimate = Estimate(
            cluster.mean, cluster.covariance, self._sure, cluster.weight, seen.share, seen.known, searched
        )
        return self._estimate

    def _carried(self, moved: Array) -> Estimate:
        assert self._estimate is not None  # noqa: S101 - who calls has looked
        pose = compose(self._estimate.pose, moved)
        self._estimate = replace(self._estimate, pose=pose, searched=False)
        return self._estimate

    def _unsure(self) -> None:
        self._sure = False
        self._since_search = math.inf
        self._agreed = 0.0
        self._doubted = 0.0
        self._regained = 0.0
        self._leader = None

    def _judge_tracking(self, cluster: Cluster, share: float, known: float, travelled: float, continues: bool) -> None:
        params = self.params
        deviation = math.sqrt(max(cluster.covariance[0, 0], cluster.covariance[1, 1]))
        contradicts = known >= params.doubt_known and share < params.doubt_share
        if not self._sure:
            # A pose that was doubted is sure again where the map explains it for long enough.
            agrees = self._believed and known >= params.sure_known and share >= params.sure_share
            self._regained = self._regained + travelled if agrees and cluster.weight > 0.9 else 0.0
            if self._regained >= params.sure_distance and deviation <= params.lost_deviation:
                self._sure = True
                self._doubted = 0.0
            return
        self._doubted = self._doubted + travelled if contradicts else 0.0
        carried_away = not continues and contradicts
        if carried_away:
            self._believed = False
        if carried_away or self._doubted >= params.doubt_distance or deviation > params.lost_deviation:
            self._unsure()

    def _thin(self, points: Array, count: int) -> Array:
        if len(points) <= count:
            return points
        return points[np.linspace(0, len(points) - 1, count).astype(np.int64)]

    def _weigh(self, points: Array) -> None:
        params = self.params
        total, known = score_poses(self._field, self.particles, points)
        mean = total / len(points)
        # A map that explains little of what is seen is believed as little, and odometry more.
        squash = min(params.independent_beams, float(len(points))) * (self._trust if self._believed else 1.0)
        weights = self.weights * np.exp(squash * (mean - mean.max()))
        if not self._sure or float(self.weights @ known) >= params.doubt_known * len(points):
            likelihood = float(self.weights @ np.exp(mean))
            if self._slow == 0:
                self._slow = self._fast = likelihood
            self._slow += params.alpha_slow * (likelihood - self._slow)
            self._fast += params.alpha_fast * (likelihood - self._fast)
        self.weights = weights / weights.sum()

    def _resample(self) -> None:
        params = self.params
        effective = 1 / float(np.sum(self.weights**2))
        share = 0.0
        if self._slow > 0 and not self._believed:
            # Not against a pose that is believed: where the map lacks a room, strangers always fit better somewhere.
            share = min(max(0.0, 1 - self._fast / self._slow), params.random_share)
        if effective > len(self.weights) / 2 and share < 0.02:
            return
        drawn = low_variance_sample(self.weights, params.max_particles, float(self._random.random()))
        bins = len(np.unique(bin_keys(self.particles[drawn], params.bin_size, params.bin_turn)))
        count = kld_count(bins, params.kld_error, params.kld_quantile)
        count = min(max(count, params.min_particles), params.max_particles)
        strangers = int(share * count)
        drawn = low_variance_sample(self.weights, count - strangers, float(self._random.random()))
        self.particles = np.vstack((self.particles[drawn], self._anywhere(strangers)))
        self.weights = np.full(count, 1 / count)
        if strangers:
            # As in nav2_amcl: they had their chance.
            self._slow = self._fast

    def _anywhere(self, count: int) -> Array:
        cells = self._field.free[self._random.integers(0, len(self._field.free), count)]
        places = self._field.grid.to_points(cells + self._random.random((count, 2)))
        return np.column_stack((places, self._random.uniform(-np.pi, np.pi, count)))

    def _around(self, pose: Array, covariance: Array, count: int) -> Array:
        drawn = self._random.multivariate_normal(pose, covariance, count, method="eigh")
        drawn[:, 2] = wrap(drawn[:, 2])
        return drawn

    def _recent(self, origin: Array) -> tuple[Array, Array]:
        """Beams of the scans that are kept, as starts and ends in the robot's frame now [m]."""
        starts, ends = [], []
        for key in self._odometry.keys:
            at = between(self._odometry.pose, key.pose)
            cos, sin = math.cos(at[2]), math.sin(at[2])
            turn = np.array([[cos, sin], [-sin, cos]])
            ends.append(key.points @ turn + at[:2])
            starts.append(np.broadcast_to(origin @ turn + at[:2], key.points.shape))
        return np.vstack(starts), np.vstack(ends)

    def _search(self, origin: Array, cluster: Cluster) -> None:
        params = self.params
        driven = self._since_search if math.isfinite(self._since_search) else 0.0
        self._since_search = 0.0
        starts, ends = self._recent(origin)
        found = search(self._field, starts, ends, self._random, params.search)
        if not found:
            return
        chosen = self._random.permutation(len(ends))[: 4 * params.search.points]
        here = judge(self._field, cluster.mean, starts[chosen], ends[chosen])
        first = found[0]
        lead = self._lead(first, [*found[1:], here])
        best = first.explained
        good = best.share >= params.sure_share and best.known >= params.sure_known and lead >= params.sure_lead
        if good and self._leader is not None and self._is_same(first.pose, self._leader):
            self._agreed += driven
        else:
            self._agreed = 0.0
        self._leader = first.pose if good else None
        if not self._believed:
            self._sow(found)
        if good and self._agreed >= params.sure_distance:
            self._sure = self._believed = True
            self._trust = 1.0
            self._slow = self._fast = 0.0
            self._doubted = 0.0
            self.particles = self._around(first.pose, np.diag([0.01, 0.01, 0.001]), params.max_particles)
            self.weights = np.full(params.max_particles, 1 / params.max_particles)

    def _lead(self, first: Hypothesis, others: list[Hypothesis]) -> float:
        scores = [other.score for other in others if not self._is_same(other.pose, first.pose)]
        return first.score - max(scores, default=-math.inf)

    def _is_same(self, a: Array, b: Array) -> bool:
        params = self.params
        near = math.hypot(a[0] - b[0], a[1] - b[1]) <= params.cluster_radius
        return near and abs(float(wrap(np.array(a[2] - b[2])))) <= params.cluster_turn

    def _sow(self, found: list[Hypothesis]) -> None:
        """Give half of the particles to the hypotheses, by their scores; they replace the least likely."""
        params = self.params
        count = params.max_particles // 2
        # A score is of one beam; as in weighing, they count as some independent ones.
        scores = np.array([hypothesis.score for hypothesis in found])
        shares = np.exp(params.independent_beams / 2 * (scores - scores.max()))
        drawn = low_variance_sample(shares, count, float(self._random.random()))
        poses = np.array([found[index].pose for index in drawn])
        poses = poses + self._random.standard_normal((count, 3)) * (0.1, 0.1, 0.03)
        poses[:, 2] = wrap(poses[:, 2])
        kept = low_variance_sample(self.weights, params.max_particles - count, float(self._random.random()))
        self.particles = np.vstack((self.particles[kept], poses))
        self.weights = np.full(len(self.particles), 1 / len(self.particles))
