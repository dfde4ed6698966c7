"""Particle sets: resampling, how many are needed, where they gather."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skytether_services.navigation.compiled import compiled
from skytether_services.navigation.poses import wrap

Array = NDArray[np.float64]


def low_variance_sample(weights: Array, count: int, offset: float) -> NDArray[np.int64]:
    """Indices of particles, each as often as its weight says, by one random number (Probabilistic Robotics, table 4.4).

    Args:
        weights: Not negative, with a positive sum.
        count: How many are drawn.
        offset: From [0, 1).
    """
    cumulated = np.cumsum(weights)
    marks = (offset + np.arange(count)) * (cumulated[-1] / count)
    indices: NDArray[np.int64] = np.searchsorted(cumulated, marks, side="right").astype(np.int64)
    indices[indices >= len(weights)] = len(weights) - 1
    return indices


def kld_count(bins: int, error: float, quantile: float) -> int:
    """Particles needed for as many bins (Fox 2003, equation 7).

    Args:
        bins: That have a particle in them.
        error: Largest Kullback-Leibler distance from the true posterior.
        quantile: Of the normal distribution, for the probability with which that holds: 2.33 for 99 percent.
    """
    if bins <= 1:
        return 1
    part = 2 / (9 * (bins - 1))
    return math.ceil((bins - 1) / (2 * error) * (1 - part + math.sqrt(part) * quantile) ** 3)


@compiled
def bin_keys(particles: Array, cell: float, turn: float) -> NDArray[np.int64]:
    """A number for the bin of each particle: ``cell`` by ``cell`` [m] by ``turn`` [rad]."""
    turns = max(1, round(2 * math.pi / turn))
    keys = np.empty(particles.shape[0], np.int64)
    for index in range(particles.shape[0]):
        x = math.floor(particles[index, 0] / cell) + 2**20
        y = math.floor(particles[index, 1] / cell) + 2**20
        heading = math.floor((particles[index, 2] + math.pi) / (2 * math.pi) * turns) % turns
        keys[index] = (x * 2**21 + y) * turns + heading
    return keys


@dataclass(frozen=True)
class Cluster:
    """Where particles gather.

    Attributes:
        mean: x [m], y [m], heading [rad].
        covariance: 3 by 3.
        weight: Share of all particles' weight.
    """

    mean: Array
    covariance: Array
    weight: float


@compiled
def _heaviest(keys: NDArray[np.int64], weights: Array) -> int:
    """The key whose entries weigh most; of equals the least."""
    order = np.argsort(keys, kind="mergesort")
    best, most, total = keys[order[0]], -1.0, 0.0
    for place in range(keys.shape[0]):
        key = keys[order[place]]
        total += weights[order[place]]
        if place + 1 == keys.shape[0] or keys[order[place + 1]] != key:
            if total > most:
                best, most = key, total
            total = 0.0
    return int(best)


@compiled
def _within(particles: Array, centre: Array, radius: float, turn: float) -> NDArray[np.bool_]:
    inside = np.empty(particles.shape[0], np.bool_)
    for index in range(particles.shape[0]):
        angle = particles[index, 2] - centre[2]
        angle -= 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))
        dx, dy = particles[index, 0] - centre[0], particles[index, 1] - centre[1]
        inside[index] = dx * dx + dy * dy <= radius * radius and abs(angle) <= turn
    return inside


def heaviest_cluster(particles: Array, weights: Array, radius: float, turn: float) -> Cluster:
    """Mean and covariance of the particles around the heaviest bin.

    Args:
        particles: n by 3: x [m], y [m], heading [rad].
        weights: Sum to 1.
        radius: How far from its middle a cluster reaches [m].
        turn: And in heading [rad].
    """
    keys = bin_keys(particles, radius, turn)
    mean, covariance, weight = _moments(particles, weights, keys == _heaviest(keys, weights))
    for _ in range(2):
        inside = _within(particles, mean, radius, turn)
        if not inside.any():
            break
        mean, covariance, weight = _moments(particles, weights, inside)
    return Cluster(mean, covariance, weight)


def moments(particles: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean and covariance of poses; headings as directions."""
    mean, covariance, _ = _moments(particles, weights, np.ones(len(particles), np.bool_))
    return mean, covariance


def bulk(particles: Array, weights: Array, deviations: float) -> NDArray[np.bool_]:
    """Which poses are within so many standard deviations of their weighted mean (Mahalanobis' distance)."""
    mean, covariance = moments(particles, weights)
    away = particles - mean
    away[:, 2] = wrap(away[:, 2])
    information = np.linalg.inv(covariance + np.diag([1e-6, 1e-6, 1e-6]))
    inside: NDArray[np.bool_] = np.einsum("ij,jk,ik->i", away, information, away) <= deviations**2
    return inside


@compiled
def _moments(particles: Array, weights: Array, chosen: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Mean and covariance of the chosen, and their weight; where they weigh nothing, all weigh the same."""
    total, count = 0.0, 0
    for i in range(particles.shape[0]):
        if chosen[i]:
            total += weights[i]
            count += 1
    x, y, cos, sin = 0.0, 0.0, 0.0, 0.0
    for i in range(particles.shape[0]):
        if chosen[i]:
            share = weights[i] / total if total > 0 else 1.0 / count
            x += share * particles[i, 0]
            y += share * particles[i, 1]
            cos += share * math.cos(particles[i, 2])
            sin += share * math.sin(particles[i, 2])
    mean = np.array([x, y, math.atan2(sin, cos)])
    covariance = np.zeros((3, 3))
    for i in range(particles.shape[0]):
        if chosen[i]:
            share = weights[i] / total if total > 0 else 1.0 / count
            dx, dy, turned = particles[i, 0] - mean[0], particles[i, 1] - mean[1], particles[i, 2] - mean[2]
            turned -= 2 * math.pi * math.floor((turned + math.pi) / (2 * math.pi))
            covariance[0, 0] += share * dx * dx
            covariance[0, 1] += share * dx * dy
            covariance[0, 2] += share * dx * turned
            covariance[1, 1] += share * dy * dy
            covariance[1, 2] += share * dy * turned
            covariance[2, 2] += share * turned * turned
    covariance[1, 0], covariance[2, 0], covariance[2, 1] = covariance[0, 1], covariance[0, 2], covariance[1, 2]
    return mean, covariance, total
