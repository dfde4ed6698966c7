"""Adaptive Monte Carlo localisation: where in a known map the robot is, from odometry and laser.

While a pose is believed, a particle filter tracks it: motion by wheels and laser (`scan_odometry`) with the error that
the match of the scans had, the likelihood field of the beams that the map explains, low-variance resampling with as
many particles as KLD sampling asks for. Where the map explains little, as in a room that it lacks, the particles are
not weighed: then odometry alone carries the pose.

A beam that ends where the map is free met something that the map does not show. That speaks neither for a pose nor
against it, so a field of such things is driven through by the few walls seen between them. What speaks against a pose
is a beam that passed through a wall.

Where no pose is believed, hypotheses come from a search of the whole map with the scans of the last metres put
together. They are searched for again while the robot drives, until one explains more than every other. Where the map
contradicts the pose that is believed, it is searched beside the tracking: the robot may have been carried away, or be
in a room that the map lacks. The pose changes only where another place explains clearly more.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.global_search import Hypothesis, SearchParams, distinct, search
from skytether_services.navigation.likelihood_field import (
    EXPLAINED,
    OPEN,
    Explained,
    LikelihoodField,
    compare_beams,
    explain,
    score_poses,
)
from skytether_services.navigation.motion_model import move_particles
from skytether_services.navigation.particles import (
    Cluster,
    bin_keys,
    bulk,
    heaviest_cluster,
    kld_count,
    low_variance_sample,
)
from skytether_services.navigation.poses import between, compose, wrap
from skytether_services.navigation.scan_matching import with_normals
from skytether_services.navigation.scan_odometry import ScanOdometry, ScanOdometryParams

Array = NDArray[np.float64]


_BULK = 2.5
"""Standard deviations of a cloud of particles within which one is looked for that the map explains: where it explains
nothing, as in a room that it lacks, some particle far out finds walls that fit by chance."""


_AS_USUAL = 0.8
"""Of what scans continued before one that did not: then a robot that stood all the time is where it was."""


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
        least_explained: The map is not asked where it explains no more than this share of the beams that do not end in
            the open: there odometry carries the pose, for what bits of map near by explain is explained wrongly.
        well_explained: It is asked without reserve from this share on.
        gathered: Up to this standard deviation the middle of the particles tells which beams the map explains [m].
        update_distance: The map is asked after so much motion [m].
        update_turn: Or after so much turning [rad].
        renewed_distance: A match of scans errs independently of one so much motion before [m].
        cluster_radius: Particles as near as this are in the same place [m].
        cluster_turn: And in heading [rad].
        scans: How scans are matched with each other.
        search: How the map is searched.
        search_keys: With so many of the last kept scans.
        search_distance: While no pose is believed, the map is searched each time after so much motion [m].
        sure_share: It becomes sure where the map explains this share of the beams.
        sure_known: And has something to say about this share of them.
        sure_lead: And every other place explains less, by so much of the score.
        least_share: A search makes it sure with as little as this, too, by a larger lead: see `lead_needed`.
        sure_distance: After so much motion within one place [m].
        doubt_share: It doubts where more than this share of the telling beams passed through an obstacle of the map.
        doubt_known: While the map has something to say about at least this share of the beams: about fewer where the
            robot is in a room that the map lacks.
        doubt_telling: And while at least this share of all beams is telling.
        doubt_distance: For so much motion [m]; motion with scans that agree is taken off.
        doubt_search: Then the map is searched after so much motion, and each time in vain after twice as much; where it
            seems to have been carried away, at most after so much [m].
        doubt_search_most: But after so much at most [m].
        carried_from: Share of all beams that the map explained before scans broke off, for a robot to be carried away.
        carried_to: And at most this share after it.
        lost_deviation: Standard deviation of the position from which on it is not sure [m].
    """

    min_particles: int = 500
    max_particles: int = 2000
    kld_error: float = 0.05
    kld_quantile: float = 2.33
    bin_size: float = 0.25
    bin_turn: float = math.radians(10)
    beams: int = 120
    independent_beams: float = 30.0
    max_beam: float = 25.0
    least_explained: float = 0.5
    well_explained: float = 0.8
    gathered: float = 0.15
    update_distance: float = 0.05
    update_turn: float = 0.03
    renewed_distance: float = 0.7
    cluster_radius: float = 0.6
    cluster_turn: float = math.radians(30)
    scans: ScanOdometryParams = field(default_factory=ScanOdometryParams)
    search: SearchParams = field(default_factory=SearchParams)
    search_keys: int = 40
    search_distance: float = 0.4
    sure_share: float = 0.7
    sure_known: float = 0.6
    sure_lead: float = 0.25
    least_share: float = 0.4
    sure_distance: float = 1.0
    doubt_share: float = 0.5
    doubt_known: float = 0.6
    doubt_telling: float = 0.2
    doubt_distance: float = 0.5
    doubt_search: float = 1.0
    doubt_search_most: float = 4.0
    carried_from: float = 0.5
    carried_to: float = 0.35
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
        self._odometry = ScanOdometry(self.params.scans)
        self._sure = self._believed = False
        self._since_asked = np.zeros(3)
        self._since_search = math.inf
        self._search_wait = self._search_most = 0.0
        self._kept_before = self._searches = 0
        self._agreed = self._doubted = self._regained = self._usual = 0.0
        self._hypotheses: list[Array] = []
        self._before: deque[float] = deque(maxlen=10)
        self._estimate: Estimate | None = None
        self.particles: Array = np.zeros((0, 3))
        self.weights: Array = np.zeros(0)
        self.forget()

    def forget(self) -> None:
        """Begin anew without any pose: the robot may be anywhere in the map."""
        params = self.params
        cells = self._field.free[self._random.integers(0, len(self._field.free), params.max_particles)]
        places = self._field.grid.to_points(cells + self._random.random((params.max_particles, 2)))
        headings = self._random.uniform(-np.pi, np.pi, params.max_particles)
        self._spread(np.column_stack((places, headings)))
        self._odometry.forget()
        self._estimate = None
        self._disbelieve()

    def place(self, pose: Array, covariance: Array) -> None:
        """Begin anew at a pose that somebody gave; it is believed until the scans say otherwise.

        Args:
            pose: x [m], y [m], heading [rad], map frame.
            covariance: Of it, 3 by 3 [m², rad²].
        """
        self._spread(self._random.multivariate_normal(pose, covariance, self.params.max_particles, method="eigh"))
        self._believe()
        self._estimate = None

    def update(self, step: Array, points: Array, origin: Array | None = None) -> Estimate:
        """Take what odometry and laser say.

        Args:
            step: What odometry says of the motion since the last update, in the robot's frame before it: x [m], y [m],
                heading [rad].
            points: n by 2: ends of the beams that met something, in the robot's frame, in their order [m]. May be none.
            origin: x, y of the laser in the robot's frame [m]; None: as the robot's.
        """
        params = self.params
        origin = np.zeros(2) if origin is None else origin
        if not np.isfinite(step).all():
            step = np.zeros(3)
        points = points[np.isfinite(points).all(axis=1)]
        points = points[np.hypot(points[:, 0] - origin[0], points[:, 1] - origin[1]) <= params.max_beam]
        scan = self._odometry.update(step, with_normals(points, origin))
        travelled = _length(scan.motion)
        # A scan is matched with the same surfaces as the one before: errors add up only as others come into sight, and
        # those of a robot that stands do not.
        renewed = params.renewed_distance if scan.matched else params.update_distance
        covariance = scan.covariance * min(1.0, travelled / renewed + 1e-6)
        self.particles = move_particles(self.particles, scan.motion, covariance, self._random)
        self._hypotheses = [compose(pose, scan.motion) for pose in self._hypotheses]
        self._since_search += travelled
        self._since_asked = compose(self._since_asked, scan.motion)
        away = self._since_asked
        still = math.hypot(away[0], away[1]) < params.update_distance and abs(away[2]) < params.update_turn
        # What is carried away does not turn its wheels; one that drives sees nothing new at once but what stands in its
        # way.
        carried = scan.jumped and _length(step) < params.update_distance
        if still and self._estimate is not None and not (scan.broken or carried):
            if self._usual and scan.overlap >= _AS_USUAL * self._usual:
                # Somebody stood before the laser.
                self._sure, self._usual = True, 0.0
            pose = compose(self._estimate.pose, scan.motion)
            self._estimate = replace(self._estimate, pose=pose, sure=self._sure, searched=False)
            return self._estimate
        self._usual = scan.usual if carried and self._sure else 0.0
        self._since_asked = np.zeros(3)
        if self._believed:
            # By where it is, not by its way: what trembles does not drive.
            self._estimate = self._track(points, origin, _length(away), scan.broken, carried)
        if not self._believed:
            self._estimate = self._find(points, origin)
        assert self._estimate is not None  # noqa: S101 - one of both was done
        return self._estimate

    def _spread(self, particles: Array) -> None:
        self.particles = particles
        self.particles[:, 2] = wrap(self.particles[:, 2])
        self.weights = np.full(len(particles), 1 / len(particles))

    def _believe(self) -> None:
        self._sure = self._believed = True
        self._doubted = self._regained = self._usual = 0.0
        self._hypotheses = []
        self._search_wait = self.params.doubt_search
        self._kept_before = self._odometry.kept
        self._before.clear()

    def _disbelieve(self) -> None:
        self._sure = self._believed = False
        self._usual = 0.0
        self._since_search = math.inf
        self._search_wait = self.params.search_distance
        self._kept_before = 0
        self._agreed = 0.0
        self._hypotheses = []

    def _cluster(self) -> Cluster:
        return heaviest_cluster(self.particles, self.weights, self.params.cluster_radius, self.params.cluster_turn)

    # Tracking

    def _track(self, points: Array, origin: Array, travelled: float, broken: bool, carried: bool) -> Estimate:
        params = self.params
        if len(points) > params.beams:
            points = points[np.linspace(0, len(points) - 1, params.beams).astype(np.int64)]
        starts = np.broadcast_to(origin, points.shape)
        cluster = self._cluster()
        at = cluster.mean
        if _deviation(cluster) > params.gathered:
            # The middle of a wide cloud may explain nothing, though some particle is right.
            near = self.particles[bulk(self.particles, self.weights, _BULK)]
            at = near[int(score_poses(self._field, near, points).argmax())]
        beams = compare_beams(self._field, at, starts, points)
        fits = beams == EXPLAINED
        # What stands in the open, on no map, says nothing of where the robot is.
        share = float(fits.sum()) / max(int((beams != OPEN).sum()), 1)
        trust = (share - params.least_explained) / (params.well_explained - params.least_explained)
        # Neighbours err alike, and those that are left out leave as many neighbours to each of the others.
        alike = min(1.0, params.independent_beams / max(len(points), 1))
        self._weigh(points[fits], alike * min(max(trust, 0.0), 1.0))
        cluster = self._cluster()
        seen = explain(self._field, cluster.mean, starts, points)
        self._judge(cluster, seen, travelled, broken, carried)
        searched = self._believed and not self._sure and self._since_search >= self._search_wait
        if searched and self._search_beside(cluster.mean, origin):
            cluster = self._cluster()
            seen = explain(self._field, cluster.mean, starts, points)
        elif self._believed:
            self._resample()
        return Estimate(cluster.mean, cluster.covariance, self._sure, cluster.weight, seen.share, seen.known, searched)

    def _weigh(self, points: Array, trust: float) -> None:
        if trust == 0 or len(points) == 0:
            return
        total = score_poses(self._field, self.particles, points)
        total *= trust
        weights = self.weights * np.exp(total - total.max())
        self.weights = weights / weights.sum()

    def _resample(self) -> None:
        params = self.params
        if 1 / float(np.sum(self.weights**2)) > len(self.weights) / 2:
            return
        drawn = low_variance_sample(self.weights, params.max_particles, float(self._random.random()))
        bins = len(np.unique(bin_keys(self.particles[drawn], params.bin_size, params.bin_turn)))
        count = kld_count(bins, params.kld_error, params.kld_quantile)
        count = min(max(count, params.min_particles), params.max_particles)
        self._spread(self.particles[low_variance_sample(self.weights, count, float(self._random.random()))])

    def _judge(self, cluster: Cluster, seen: Explained, travelled: float, broken: bool, carried: bool) -> None:
        """Whether the pose is still believed, and sure."""
        params = self.params
        explained = seen.share * seen.known
        before = max(self._before, default=0.0)
        if broken and before >= params.carried_from and explained <= params.carried_to:
            self._disbelieve()
            return
        if broken or carried:
            # Carried to a place that looks alike, or from or to one that the map lacks; or all around it has changed.
            self._doubt(params.search_distance, params.doubt_search)
        self._before.append(explained)
        tells = seen.known >= params.doubt_known and seen.telling >= params.doubt_telling
        contradicts = tells and seen.against > params.doubt_share
        agrees = seen.known >= params.sure_known and seen.share >= params.sure_share and cluster.weight > 0.9
        if tells:
            self._doubted = max(self._doubted + (travelled if contradicts else -travelled), 0.0)
        self._regained = self._regained + travelled if agrees else 0.0
        wide = _deviation(cluster) > params.lost_deviation
        if self._sure and not contradicts:
            self._kept_before = self._odometry.kept
        if self._sure and (wide or self._doubted >= params.doubt_distance):
            self._doubt(params.doubt_search, params.doubt_search_most)
        elif not self._sure and not wide and self._regained >= params.sure_distance:
            # Unless the last search liked another place better.
            self._sure = not self._hypotheses or self._is_same(self._hypotheses[0], cluster.mean)

    def _doubt(self, wait: float, most: float) -> None:
        """Be no longer sure of the pose, and search the map beside it: first after so much motion, at last each [m]."""
        self._sure = False
        self._since_search, self._search_wait, self._search_most = 0.0, wait, most
        self._agreed = self._regained = 0.0

    # Search

    def _find(self, points: Array, origin: Array) -> Estimate:
        """Search the map if it is time to; the estimate is the best hypothesis."""
        searched = len(points) > 0 and self._since_search >= self._search_wait
        if searched:
            self._sow(self._search(origin, self._hypotheses))
        cluster = self._cluster()
        if self._hypotheses:
            cluster = replace(cluster, mean=self._hypotheses[0])
        seen = explain(self._field, cluster.mean, np.broadcast_to(origin, points.shape), points)
        return Estimate(cluster.mean, cluster.covariance, self._sure, cluster.weight, seen.share, seen.known, searched)

    def _recent(self, origin: Array) -> tuple[Array, Array, Array]:
        """Beams of the scans that were kept last, as starts and ends, and the poses from which they were.

        All are in the robot's frame now [m, rad], the oldest first.

        What was kept while the pose was not in doubt is not among them: it may be of the place before.
        """
        starts, ends, poses = [], [], []
        keys = list(self._odometry.keys)
        count = min(self.params.search_keys, self._odometry.kept - self._kept_before, len(keys))
        for key in keys[len(keys) - count :]:
            at = between(self._odometry.pose, key.pose)
            cos, sin = math.cos(at[2]), math.sin(at[2])
            turn = np.array([[cos, sin], [-sin, cos]])
            ends.append(key.points[:, :2] @ turn + at[:2])
            starts.append(np.broadcast_to(origin @ turn + at[:2], ends[-1].shape))
            poses.append(at)
        if not ends:
            return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((1, 3))
        return np.vstack(starts), np.vstack(ends), np.array(poses)

    def _search(self, origin: Array, also: list[Array]) -> list[Hypothesis]:
        """Search the map, and believe what was the best for long enough; the hypotheses if there is no such.

        Args:
            origin: x, y of the laser in the robot's frame [m].
            also: Poses that are looked at in any case.
        """
        params = self.params
        driven = self._since_search if math.isfinite(self._since_search) else 0.0
        starts, ends, way = self._recent(origin)
        # From where the robot is now and from where it was first, in turn: it may have left what the map knows, or have
        # come onto it.
        from_first = self._searches % 2 == 1
        self._searches += 1
        found = search(self._field, starts, ends, self._random, params.search, also, way, from_first)
        if not found:
            return []
        self._since_search = 0.0
        first = found[0]
        lead = first.score - found[1].score if len(found) > 1 else math.inf
        known = first.explained.known >= params.sure_known
        credit = lead_credit(lead, first.explained.share, params) if known else 0.0
        good = credit == 1.0
        if self._believed and not good:
            # What is believed is given up for nothing less.
            credit = 0.0
        same = bool(self._hypotheses) and self._is_same(first.pose, self._hypotheses[0])
        self._agreed = self._agreed + credit * driven if same else 0.0
        self._hypotheses = [hypothesis.pose for hypothesis in found]
        if self._agreed < params.sure_distance:
            if self._believed:
                # What looks good is soon looked at again.
                wait = min(2 * max(self._search_wait, params.doubt_search / 2), self._search_most)
                self._search_wait = params.search_distance if good else wait
            return found
        self._spread(self._random.multivariate_normal(first.pose, np.diag([0.01, 0.01, 0.001]), params.max_particles))
        self._believe()
        return []

    def _search_beside(self, pose: Array, origin: Array) -> bool:
        """Search the map while a pose is believed but not sure; whether it now is, or another one in its place."""
        self._search(origin, [pose, *self._hypotheses])
        return self._sure

    def _is_same(self, a: Array, b: Array) -> bool:
        params = self.params
        return len(distinct(np.stack((a, b)), params.search.apart, params.search.apart_turn, 2)) == 1

    def _sow(self, found: list[Hypothesis]) -> None:
        """Particles around the hypotheses, by their scores."""
        params = self.params
        if not found:
            return
        # A score is of one beam; as in weighing, they count as some independent ones.
        scores = np.array([hypothesis.score for hypothesis in found])
        shares = np.exp(params.independent_beams * (scores - scores.max()))
        drawn = low_variance_sample(shares, params.max_particles, float(self._random.random()))
        poses = np.array([found[index].pose for index in drawn])
        self._spread(poses + self._random.standard_normal(poses.shape) * (0.1, 0.1, 0.03))


def lead_needed(share: float, params: LocalisationParams) -> float:
    """By how much of the score the best place of a search has to lead, for the share of the beams that it explains.

    Scans put together hold people, and what was moved since: then the right place explains little, but places that
    are wrong explain much less, and all about as little as each other.
    """
    if share < params.least_share:
        return math.inf
    return params.sure_lead + max(0.0, params.sure_share - share)


def lead_credit(lead: float, share: float, params: LocalisationParams) -> float:
    """Which part of the motion within one place counts, by the lead with which it is the best, from 0 to 1.

    A place like others leads by less than is needed, but then it leads again and again. Less than half of that is
    chance.
    """
    part = lead / lead_needed(share, params) if share >= params.least_share else 0.0
    return min(part, 1.0) if part >= 0.5 else 0.0


def _length(motion: Array) -> float:
    """Of a motion, its turning included [m]."""
    return math.hypot(motion[0], motion[1]) + 0.3 * abs(float(motion[2]))


def _deviation(cluster: Cluster) -> float:
    """Standard deviation of the position along the wider axis [m]."""
    return math.sqrt(max(cluster.covariance[0, 0], cluster.covariance[1, 1]))
