"""Absolute line numbers: which projected line each fragment belongs to.

In inspection the template says where each line is expected, and a point within just under half a
pitch of it is that line (`Gate`). Without a template the fragments are numbered by the most
probable assignment (`number_fragments`): every fragment may bear the numbers whose heights lie in
the calibrated range, or none; neighbours across the lines keep their order, count up by one unless
a line is missing between them, and rather lie at like heights; pieces that follow each other along
a line rather go on at the same height; the spot and corrections by hand are fixed. Minimum-sum
belief propagation on this graph gives each fragment its number and the margin to the next best;
what is not clearly ahead stays without a number.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from wearline.artifact import Calibration
from wearline.config import Settings
from wearline.recipe import LineConstraint
from wearline_reconstruct.core.lines import Fragments
from wearline_reconstruct.core.spot import Spot
from wearline_reconstruct.core.stripes import F32, F64, I64, Bool

NONE = -1
_NEVER = 1e4
_COLUMN_STEP = 4
_MOST_FRAGMENTS = 400
_MOST_PATCHES = 80


class NumberingSettings(Settings):
    """How sure a line number must be."""

    gate_share: float = 0.48
    """In inspection, a point within this share of the pitch from the template's line is that line."""
    least_margin: float = 2.0
    """Cost by which the best number must lead; 1 = a height difference of one pitch over four columns."""
    least_patch_margin: float = 0.2
    """And per cross section of its rim, a patch of lines against the same patch one number off."""


@dataclass(frozen=True)
class Gate:
    """Where the template expects which line."""

    image: NDArray[np.uint8]
    """[along, across]: line number, 255 = none."""
    middle_px: F32
    """[along]: expected place of the middle line, NaN = not seen. [px]"""
    expected: Bool
    """(line, along): the template has a point."""


def make_gate(line_across_px: F32, coverage: F32, across_size: int, pitch_px: float, share: float) -> Gate:
    """Build the look-up image of a template: (line, along) places and their coverage."""
    lines, along_size = line_across_px.shape
    across = np.where(coverage >= 0.5, line_across_px, np.nan).astype(np.float64)
    image = np.full((along_size, across_size), 255, np.uint8)
    reach = np.full(across.shape, share * pitch_px)
    gap = np.diff(across, axis=0)
    with np.errstate(invalid="ignore"):
        reach[1:] = np.where(np.isfinite(gap), np.minimum(reach[1:], 0.5 * gap), reach[1:])
        reach[:-1] = np.where(np.isfinite(gap), np.minimum(reach[:-1], 0.5 * gap), reach[:-1])
    for line in range(lines):
        columns = np.flatnonzero(np.isfinite(across[line]))
        if not len(columns):
            continue
        low = np.ceil(across[line, columns] - reach[line, columns]).astype(np.int64)
        high = np.floor(across[line, columns] + reach[line, columns]).astype(np.int64)
        offset = np.arange(int((high - low).max()) + 1)
        place = low[:, None] + offset
        inside = (place <= high[:, None]) & (place >= 0) & (place < across_size)
        image[np.broadcast_to(columns[:, None], place.shape)[inside], place[inside]] = line
    return Gate(image, across[lines // 2].astype(np.float32), np.isfinite(across))


def number_by_gate(found: Fragments, gate: Gate) -> I64:
    """Line number per peak; `NONE` where the template expects no line."""
    across = np.clip(np.rint(found.peaks.across_px), 0, gate.image.shape[1] - 1).astype(np.int64)
    number = gate.image[found.peaks.along, across].astype(np.int64)
    return np.where(number == 255, NONE, number)


@dataclass(frozen=True)
class Numbers:
    """Numbers of fragments, [fragment]."""

    number: I64
    """`NONE` where nothing settles it."""
    margin: F64


@dataclass(frozen=True)
class _Rules:
    """What jumps and missing lines cost, per cross section."""

    jump: float
    """A height difference that moves a line by one pitch."""
    missing: float
    """The first line missing without a reason."""
    further: float
    """Each further one."""
    wall: float
    """+1: walls that rise with the line number face the laser and swallow lines; -1: those that fall."""
    alive: Bool
    """(line,): seen somewhere."""


@dataclass(frozen=True)
class _Pairs:
    first: I64
    second: I64
    cost: F64
    """[pair, label of first, label of second]"""
    weight: F64
    """Cross sections that show the pair."""
    jump: F64
    """[pair, label of first, label of second]: rise from the one to the other, in pitch heights."""
    is_beside: Bool
    """Nothing lies between the two."""


def number_fragments(
    found: Fragments,
    calibration: Calibration,
    pitch_px: float,
    spots: list[Spot],
    constraints: tuple[LineConstraint, ...],
    settings: NumberingSettings,
) -> Numbers:
    """Number the fragments of a frame without a template."""
    count = found.count
    number, margin = np.full(count, NONE), np.zeros(count)
    if count == 0:
        return Numbers(number, margin)
    size = np.bincount(found.label)
    chosen = np.sort(np.argsort(-size, kind="stable")[:_MOST_FRAGMENTS])
    index_of = np.full(count, -1)
    index_of[chosen] = np.arange(len(chosen))
    # Every fourth column says all; the first and last peak of a fragment stay, for what follows along the line.
    peaks, ends = found.peaks, found.first
    sparse = peaks.along % _COLUMN_STEP == 0
    sparse[ends[:-1]] = True
    sparse[ends[1:] - 1] = True
    use = np.flatnonzero(sparse & (index_of[found.label] >= 0))
    node = index_of[found.label[use]]
    along, across = peaks.along[use].astype(np.int64), peaks.across_px[use].astype(np.float64)
    d = across - calibration.across0_px[:, along]
    z = calibration.a_mm_per_px[:, along] * d / (1.0 + calibration.b_per_px * d)
    a_usual = float(np.nanmedian(calibration.a_mm_per_px[:, ::16]))
    step_mm = abs(a_usual) * pitch_px
    low, high = calibration.z_range_mm
    with np.errstate(invalid="ignore"):
        fits = (z >= low) & (z <= high)
    # Points are ordered by fragment, so that sums over fragments are sums over slices.
    starts = np.searchsorted(node, np.arange(len(chosen)))
    total = np.diff(np.append(starts, len(node)))
    share = np.add.reduceat(fits.astype(np.float64), starts, axis=1).T / total[:, None]
    labels = calibration.lines + 1
    unary = np.full((len(chosen), labels), _NEVER)
    unary[:, :-1] = np.where(share >= 0.7, 4.0 * (1.0 - share), _NEVER)
    signal = peaks.signal_dn[use].astype(np.float64)
    strength = np.add.reduceat(signal, starts) / total / max(float(np.median(signal)), 1e-6)
    unary[:, -1] = 1.5 * total * np.clip(strength, 0.1, 1.0) + 0.5
    _fix(unary, along, across, node, pitch_px, spots, constraints, calibration)
    follow = _neighbours_along(node, along, across, z, step_mm, pitch_px, labels, len(chosen))
    wall = -float(np.sign(a_usual))
    alive = np.isfinite(calibration.across0_px).any(axis=1)
    pairs = _neighbours_across(node, along, across, z, step_mm, labels, len(chosen), _Rules(1.0, 0.6, 0.25, wall, alive))
    best, lead = _propagate(unary, [pairs, follow])
    if not _is_plain(best, pairs, unary):
        # Lines that are somewhere in the picture do not vanish elsewhere without a reason; dead ones do.
        alive = np.bincount(best, weights=total, minlength=labels)[:-1] > 0
        pairs = _neighbours_across(
            node, along, across, z, step_mm, labels, len(chosen), _Rules(0.6, 1.6, 0.5, wall, alive)
        )
        best, lead = _propagate(unary, [pairs, follow])
        best, lead = _shifted_patches(best, lead, unary, pairs, follow, settings.least_patch_margin)
    settled = (best < calibration.lines) & (lead >= settings.least_margin)
    settled &= unary[np.arange(len(chosen)), best] < _NEVER
    result = np.where(settled, best, NONE)
    result = _ordered(result, lead, node, along, across)
    number[chosen] = result
    margin[chosen] = lead
    return Numbers(number, margin)


def _fix(
    unary: F64, along: I64, across: F64, node: I64, pitch_px: float, spots: list[Spot],
    constraints: tuple[LineConstraint, ...], calibration: Calibration,
) -> None:  # fmt: skip
    """Enter the spot and the corrections by hand."""
    middle = calibration.lines // 2
    for spot in spots[:1]:
        nearest = _nearest_node(along, across, node, spot.along_px, spot.across_px, pitch_px)
        if nearest is not None and unary[nearest, middle] < _NEVER:
            keep = unary[nearest, middle]
            # Strong, not absolute: a reflection that passes for the spot must not outweigh the whole comb.
            unary[nearest] += 150.0
            unary[nearest, middle] = keep
    for constraint in constraints:
        if constraint.line >= calibration.lines:
            continue
        place = (constraint.row_px, constraint.col_px)
        at, over = place if calibration.is_vertical else place[::-1]
        nearest = _nearest_node(along, across, node, at, over, pitch_px)
        if nearest is not None:
            unary[nearest] = _NEVER
            unary[nearest, constraint.line] = 0.0


def _nearest_node(along: I64, across: F64, node: I64, at: float, over: float, pitch_px: float) -> int | None:
    near = np.flatnonzero(np.abs(along - at) < 0.75 * pitch_px)
    if not len(near):
        return None
    distance = np.hypot(across[near] - over, 0.3 * (along[near] - at))
    best = int(np.argmin(distance))
    return int(node[near[best]]) if distance[best] < 0.4 * pitch_px else None


def _neighbours_across(
    node: I64, along: I64, across: F64, z: F64, step_mm: float, labels: int, count: int, rules: _Rules
) -> _Pairs:
    """Fragments that are neighbours in a cross section: order, missing lines, like heights."""
    index = np.flatnonzero(along % _COLUMN_STEP == 0)
    index = index[np.lexsort((across[index], along[index]))]
    found = []
    order = np.arange(labels - 1)
    is_behind = order[None, :] <= order[:, None]
    # Lines between two numbers, those alone that could be seen.
    before = np.concatenate([[0], np.cumsum(rules.alive)])
    between = np.where(is_behind, 0, before[order][None, :] - before[order + 1][:, None]).astype(np.float64)
    for reach in (1, 2):
        upper, lower = index[:-reach], index[reach:]
        same = (along[upper] == along[lower]) & (node[upper] != node[lower])
        upper, lower = upper[same], lower[same]
        if not len(upper):
            continue
        key, inverse, weight = np.unique(
            node[upper] * count + node[lower], return_inverse=True, return_counts=True
        )
        cost = np.zeros((len(key), labels, labels))
        jump = np.zeros((len(key), labels - 1, labels - 1))
        if reach == 1:
            jump = _mean_jump(z, upper, lower, inverse, len(key)) / step_mm
            # Lines that a wall swallows are no surprise.
            lost = np.maximum(between - np.maximum(rules.wall * jump, 0.0), 0.0)
            gap = np.minimum(lost, 1.0) * rules.missing + np.maximum(lost - 1.0, 0.0) * rules.further
            cost[:, :-1, :-1] = (rules.jump * np.abs(jump) + gap) * np.minimum(weight, 60)[:, None, None]
        cost[:, :-1, :-1] = np.where(is_behind, _NEVER, cost[:, :-1, :-1])
        # One column may be a crossing of noise; it must not forbid anything for ever.
        cost = np.minimum(cost, np.where(weight >= 2, _NEVER, 4.0)[:, None, None])
        shown = np.minimum(weight, 60).astype(np.float64)
        found.append(_Pairs(key // count, key % count, cost, shown, jump, np.full(len(key), reach == 1)))
    return _joined(found, labels)


def _mean_jump(z: F64, upper: I64, lower: I64, pair: I64, pairs: int) -> F64:
    """[pair, label above, label below]: rise from the one to the other, from means over their common columns. [mm]"""
    order = np.argsort(pair, kind="stable")
    starts = np.searchsorted(pair[order], np.arange(pairs))
    weight = np.diff(np.append(starts, len(pair)))
    above, below = (
        np.add.reduceat(np.nan_to_num(z[:, side[order]], nan=1e3), starts, axis=1).T / weight[:, None]
        for side in (upper, lower)
    )
    return np.asarray((below[:, None, :] - above[:, :, None]).clip(-1e3, 1e3))


def _is_plain(best: I64, pairs: _Pairs, unary: F64) -> bool:
    """All neighbours count up by one at like heights: nothing could be one off."""
    none = unary.shape[1] - 1
    if (best == none).any():
        return False
    a, b = best[pairs.first], best[pairs.second]
    cost = pairs.cost[np.arange(len(a)), a, b] / pairs.weight
    return bool((cost < 0.3).all()) and len(np.unique(best)) == none


def _neighbours_along(
    node: I64, along: I64, across: F64, z: F64, step_mm: float, pitch_px: float, labels: int, count: int
) -> _Pairs:
    """Fragments that follow each other along the lines: the surface rather goes on at its height."""
    order = np.lexsort((along, node))
    first = order[np.searchsorted(node[order], np.arange(count))]
    last = order[np.searchsorted(node[order], np.arange(count), side="right") - 1]
    firsts, seconds, costs = [], [], []
    reach = 4.0 * pitch_px
    for source in range(count):
        end = last[source]
        gap = along[first] - along[end]
        drift = np.abs(across[first] - across[end])
        near = np.flatnonzero((gap > 0) & (gap < reach) & (drift < 1.3 * pitch_px))
        near = near[np.argsort(gap[near] + drift[near])[:3]]
        for target in near:
            jump = np.abs(z[:, end][:, None] - z[:, first[target]][None, :]) / step_mm
            cost = np.zeros((labels, labels))
            # A line that goes on without a jump is the same one; after a jump this says little.
            strength = (3.0 if drift[target] < 0.05 * pitch_px else 1.0) * (1.0 - gap[target] / reach)
            cost[:-1, :-1] = strength * np.minimum(np.nan_to_num(jump, nan=1.0), 1.0)
            firsts.append(source)
            seconds.append(int(target))
            costs.append(cost[None])
    if not costs:
        return _joined([], labels)
    n = len(costs)
    return _Pairs(
        np.array(firsts, np.int64), np.array(seconds, np.int64), np.concatenate(costs), np.ones(n),
        np.zeros((n, labels - 1, labels - 1)), np.zeros(n, bool),
    )  # fmt: skip


def _joined(groups: list[_Pairs], labels: int) -> _Pairs:
    none = np.zeros(0, np.int64)
    empty = _Pairs(
        none, none, np.zeros((0, labels, labels)), np.zeros(0), np.zeros((0, labels - 1, labels - 1)), np.zeros(0, bool)
    )
    groups = [empty, *groups]
    return _Pairs(*(np.concatenate([getattr(g, entry.name) for g in groups]) for entry in fields(_Pairs)))


def _propagate(unary: F64, groups: list[_Pairs], turns: int = 60) -> tuple[I64, F64]:
    """Minimum-sum belief propagation: best label per node and its lead over the second best."""
    first = np.concatenate([g.first for g in groups])
    second = np.concatenate([g.second for g in groups])
    cost = np.minimum(np.concatenate([g.cost for g in groups]), _NEVER).astype(np.float32)
    source = np.concatenate([first, second])
    target = np.concatenate([second, first])
    # Cost as seen by each directed message: [message, label of source, label of target].
    towards = np.concatenate([cost, cost.transpose(0, 2, 1)])
    count, labels = unary.shape
    edges = len(first)
    reverse = np.concatenate([np.arange(edges, 2 * edges), np.arange(edges)])
    message = np.zeros((2 * edges, labels), np.float32)
    own = unary.astype(np.float32)
    belief = own.copy()
    for turn in range(turns):
        if not edges:
            break
        outgoing = belief[source] - message[reverse]
        fresh = (outgoing[:, :, None] + towards).min(axis=1)
        fresh -= fresh.min(axis=1, keepdims=True)
        np.minimum(fresh, _NEVER, out=fresh)
        # Damping keeps loops from swinging.
        fresh = fresh if turn == 0 else 0.5 * fresh + 0.5 * message
        change = float(np.abs(fresh - message).max())
        message = fresh
        belief = own.copy()
        np.add.at(belief, target, message)
        if change < 1e-2:
            break
    ranked = np.sort(belief, axis=1)
    return np.argmin(belief, axis=1).astype(np.int64), (ranked[:, 1] - ranked[:, 0]).astype(np.float64)


def _energy(label: I64, unary: F64, groups: tuple[_Pairs, ...]) -> float:
    total = float(unary[np.arange(len(label)), label].sum())
    for group in groups:
        total += float(group.cost[np.arange(len(group.first)), label[group.first], label[group.second]].sum())
    return total


def _shifted_patches(
    best: I64, lead: F64, unary: F64, pairs: _Pairs, follow: _Pairs, least: float
) -> tuple[I64, F64]:
    """Let whole patches change their numbers together, and bound the leads by what such a change costs.

    Fragments beside each other hold each other's numbers firmly; whether all of them are one off is
    a question that single fragments cannot answer, and belief propagation on loops answers too surely.
    """
    none = unary.shape[1] - 1
    groups = (pairs, follow)
    best = best.copy()
    energy = _energy(best, unary, groups)
    gaps = np.full(len(unary), np.inf)
    for _ in range(4):
        gaps[:] = np.inf
        moved = False
        for members in _patches(best, pairs, len(unary), none):
            for shift in (-1, 1, -2, 2):
                trial = best.copy()
                wanted = best[members] + shift
                wanted = np.where((wanted < 0) | (wanted >= none), none, wanted)
                # What cannot bear its new number bears none.
                wanted = np.where(unary[members, wanted] >= _NEVER, none, wanted)
                if (wanted == none).all():
                    continue
                trial[members] = wanted
                cost = _energy(trial, unary, groups)
                if cost < energy - 1e-6:
                    best, energy, moved = trial, cost, True
                else:
                    gaps[members] = np.minimum(gaps[members], cost - energy - least * _rim(members, pairs))
        if not moved:
            break
    return best, np.minimum(lead, gaps)


def _rim(members: Bool, pairs: _Pairs) -> float:
    """Cross sections in which a patch has a neighbour."""
    return float(pairs.weight[members[pairs.first] != members[pairs.second]].sum())


def _patches(best: I64, pairs: _Pairs, count: int, none: int) -> list[Bool]:
    """Sets of fragments that hang together: neighbours whose numbers follow each other at like heights.

    What passes for like heights is tried at several levels, because a patch one number off may lie
    nearly flush with what surrounds it.
    """
    a, b = best[pairs.first], best[pairs.second]
    is_next = (a != none) & (b == a + 1) & pairs.is_beside
    jump = np.where(is_next, pairs.jump[np.arange(len(a)), np.minimum(a, none - 1), np.minimum(b, none - 1)], np.inf)
    found: dict[bytes, Bool] = {}
    for level in (0.05, 0.12, 0.3):
        patch = np.arange(count)
        joined = np.abs(jump) < level
        for first, second in zip(pairs.first[joined], pairs.second[joined], strict=True):
            old, new = patch[second], patch[first]
            if old != new:
                patch[patch == old] = new
        for number in np.unique(patch):
            members = (patch == number) & (best != none)
            if members.any():
                found[members.tobytes()] = members
    largest = sorted(found.values(), key=lambda members: -int(members.sum()))
    return largest[:_MOST_PATCHES]


def _ordered(number: I64, lead: F64, node: I64, along: I64, across: F64) -> I64:
    """Withdraw numbers that stand in the wrong order in some cross section; the less certain one goes."""
    number = number.copy()
    for _ in range(len(number)):
        kept = np.flatnonzero(number[node] != NONE)
        index = kept[np.lexsort((across[kept], along[kept]))]
        upper, lower = index[:-1], index[1:]
        wrong = (along[upper] == along[lower]) & (number[node[lower]] <= number[node[upper]])
        if not wrong.any():
            break
        pair, weight = np.unique(
            np.stack([node[upper[wrong]], node[lower[wrong]]]), axis=1, return_counts=True
        )
        a, b = pair[:, int(np.argmax(weight))]
        number[a if lead[a] < lead[b] else b] = NONE
    return number
