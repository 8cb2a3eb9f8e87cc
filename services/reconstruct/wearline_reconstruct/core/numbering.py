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
_LIKELY_WALL = 0.4
"""A wall of this share of a pitch explains the loss of a line."""
_BY_HAND = 1e3
_BY_SPOT = 150.0
_COLUMN_STEP = 6
_MOST_FRAGMENTS = 400
_MOST_PATCHES = 80


class NumberingSettings(Settings):
    """How sure a line number must be."""

    gate_share: float = 0.48
    """In inspection, a point within this share of the pitch from the template's line is that line."""
    least_margin: float = 2.0
    """Cost by which the best number must lead; 1 = a height difference of one pitch over six columns."""
    least_patch_margin: float = 0.45
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
class _Candidates:
    """The numbers that each fragment may bear; the last slot stands for none."""

    label: I64
    """[node, slot]: line number, `NONE` in unused slots and in the last one."""
    slot: I64
    """[node, line number]: its slot, -1 where the number is no candidate."""

    @property
    def slots(self) -> int:
        return int(self.label.shape[1])


@dataclass(frozen=True)
class _Pairs:
    first: I64
    second: I64
    cost: F64
    """[pair, slot of first, slot of second]"""
    weight: F64
    """Cross sections that show the pair."""
    jump: F64
    """[pair, slot of first, slot of second]: rise from the one to the other, in pitch heights."""
    is_beside: Bool
    """Nothing lies between the two."""

    def chosen(self, slot: I64) -> tuple[I64, I64, I64]:
        """Index of each pair's entry for these slots of the nodes."""
        return np.arange(len(self.first)), slot[self.first], slot[self.second]


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
    # Every sixth column says all; the first and last peak of a fragment stay, for what follows along the line.
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
    base = np.where(share >= 0.7, 4.0 * (1.0 - share), _NEVER)
    _fix_by_hand(base, along, across, node, pitch_px, constraints, calibration)
    candidates, unary = _candidates(base)
    if candidates.slots < 2:
        # No fragment fits any line.
        return Numbers(number, margin)
    signal = peaks.signal_dn[use].astype(np.float64)
    strength = np.add.reduceat(signal, starts) / total / max(float(np.median(signal)), 1e-6)
    unary[:, -1] = 1.5 * total * np.clip(strength, 0.1, 1.0) + 0.5
    _fix_by_spot(unary, candidates, along, across, node, pitch_px, spots, calibration.lines // 2)
    height = _Heights(np.nan_to_num(z, copy=False, nan=1e3), candidates.label, step_mm)
    follow = _neighbours_along(node, along, across, height, pitch_px, len(chosen))
    beside = _cross_sections(node, along, across, len(chosen))
    wall = -float(np.sign(a_usual))
    alive: Bool = np.asarray(np.isfinite(calibration.across0_px).any(axis=1))
    pairs = _neighbours_across(beside, height, _Rules(1.0, 0.6, 0.25, wall, alive))
    best, lead = _propagate(unary, (pairs, follow))
    if not _is_plain(best, pairs, candidates, calibration.lines):
        # Lines that are somewhere in the picture do not vanish elsewhere without a reason; dead ones do.
        named = candidates.label[np.arange(len(chosen)), best]
        alive = np.bincount(named[named != NONE], minlength=calibration.lines) > 0
        pairs = _neighbours_across(beside, height, _Rules(0.6, 1.6, 0.5, wall, alive))
        best, lead = _propagate(unary, (pairs, follow))
        best, lead = _shifted_patches(best, lead, unary, candidates, pairs, follow, settings.least_patch_margin)
    settled = (lead >= settings.least_margin) & (unary[np.arange(len(chosen)), best] < _NEVER)
    best = candidates.label[np.arange(len(chosen)), best]
    result = np.where(settled, best, NONE)
    result = _ordered(result, lead, node, along, across)
    number[chosen] = result
    margin[chosen] = lead
    return Numbers(number, margin)


def _candidates(base: F64) -> tuple[_Candidates, F64]:
    """From costs [node, line number] to slots: only what is possible, and the none at the end."""
    possible = base < _NEVER
    slots = int(possible.sum(axis=1).max(initial=0)) + 1
    order = np.argsort(~possible, axis=1, kind="stable")[:, : slots - 1]
    cost = np.take_along_axis(base, order, axis=1)
    is_used = cost < _NEVER
    label = np.concatenate([np.where(is_used, order, NONE), np.full((len(base), 1), NONE)], axis=1)
    slot = np.full(base.shape, -1)
    node, place = np.nonzero(is_used)
    slot[node, order[node, place]] = place
    unary = np.concatenate([np.where(is_used, cost, _NEVER), np.zeros((len(base), 1))], axis=1)
    return _Candidates(label, slot), unary


@dataclass(frozen=True)
class _Heights:
    """Heights of points under the candidate numbers of their fragments."""

    z_mm: F64
    """[line number, point], far away where the calibration knows nothing. [mm]"""
    label: I64
    """[node, slot]"""
    step_mm: float
    """Height that moves a line by one pitch. [mm]"""

    def mean(self, owner: I64, point: I64, starts: I64) -> F64:
        """[group, slot]: means over runs of points that begin at ``starts``, of fragment ``owner`` each."""
        weight = np.diff(np.append(starts, len(point)))
        summed = np.add.reduceat(self.z_mm[:, point], starts, axis=1) / weight
        label = np.maximum(self.label[owner], 0)
        return np.asarray(summed[label, np.arange(len(owner))[:, None]])


def _fix_by_hand(
    base: F64, along: I64, across: F64, node: I64, pitch_px: float, constraints: tuple[LineConstraint, ...],
    calibration: Calibration,
) -> None:  # fmt: skip
    """Corrections by hand leave a fragment no choice."""
    for constraint in constraints:
        if constraint.line >= calibration.lines:
            continue
        place = (constraint.row_px, constraint.col_px)
        at, over = place if calibration.is_vertical else place[::-1]
        nearest = _nearest_node(along, across, node, at, over, pitch_px)
        if nearest is not None:
            base[nearest] = _NEVER
            base[nearest, constraint.line] = -_BY_HAND


def _fix_by_spot(
    unary: F64, candidates: _Candidates, along: I64, across: F64, node: I64, pitch_px: float, spots: list[Spot],
    middle: int,
) -> None:  # fmt: skip
    """The line with the spot is the middle one."""
    for spot in spots[:1]:
        nearest = _nearest_node(along, across, node, spot.along_px, spot.across_px, pitch_px)
        if nearest is None or candidates.slot[nearest, middle] < 0:
            continue
        slot = int(candidates.slot[nearest, middle])
        keep = unary[nearest, slot]
        # Strong, not absolute: a reflection that passes for the spot must not outweigh the whole comb.
        unary[nearest] += _BY_SPOT
        unary[nearest, slot] = keep


def _nearest_node(along: I64, across: F64, node: I64, at: float, over: float, pitch_px: float) -> int | None:
    near = np.flatnonzero(np.abs(along - at) < 0.75 * pitch_px)
    if not len(near):
        return None
    distance = np.hypot(across[near] - over, 0.3 * (along[near] - at))
    best = int(np.argmin(distance))
    return int(node[near[best]]) if distance[best] < 0.4 * pitch_px else None


@dataclass(frozen=True)
class _Beside:
    """Pairs of fragments that are neighbours in cross sections, and the points that show it."""

    first: I64
    second: I64
    weight: I64
    upper: I64
    """Points of the first fragments, grouped by pair."""
    lower: I64
    starts: I64
    reach: int
    """1: nothing between them, 2: one fragment between them."""


def _cross_sections(node: I64, along: I64, across: F64, count: int) -> list[_Beside]:
    index = np.flatnonzero(along % _COLUMN_STEP == 0)
    index = index[np.lexsort((across[index], along[index]))]
    found = []
    for reach in (1, 2):
        upper, lower = index[:-reach], index[reach:]
        same = (along[upper] == along[lower]) & (node[upper] != node[lower])
        upper, lower = upper[same], lower[same]
        if not len(upper):
            continue
        key = node[upper] * count + node[lower]
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        weight = np.diff(np.append(starts, len(key)))
        name = ordered[starts]
        found.append(_Beside(name // count, name % count, weight, upper[order], lower[order], starts, reach))
    return found


def _neighbours_across(beside: list[_Beside], height: _Heights, rules: _Rules) -> _Pairs:
    """Costs of neighbours in a cross section: order, missing lines, like heights."""
    slots = height.label.shape[1]
    # Lines between two numbers, those alone that could be seen.
    before = np.concatenate([[0], np.cumsum(rules.alive)])
    groups = []
    for pair in beside:
        above, below = height.label[pair.first][:, :, None], height.label[pair.second][:, None, :]
        is_named = (above != NONE) & (below != NONE)
        is_behind = is_named & (below <= above)
        jump = np.zeros((len(pair.first), slots, slots))
        cost = np.zeros_like(jump)
        if pair.reach == 1:
            z_above = height.mean(pair.first, pair.upper, pair.starts)
            z_below = height.mean(pair.second, pair.lower, pair.starts)
            jump = ((z_below[:, None, :] - z_above[:, :, None]) / height.step_mm).clip(-100.0, 100.0)
            between = (before[np.maximum(below, 0)] - before[np.maximum(above, 0) + 1]).astype(np.float64)
            # Lines that a wall swallows are no surprise.
            wall = np.maximum(rules.wall * jump, 0.0)
            # A wall of half a pitch swallows a whole line or none.
            whole = np.floor(wall)
            lost = np.maximum(between - whole - np.minimum((wall - whole) / _LIKELY_WALL, 1.0), 0.0)
            gap = np.minimum(lost, 1.0) * rules.missing + np.maximum(lost - 1.0, 0.0) * rules.further
            shown = np.minimum(pair.weight, 40)[:, None, None]
            cost = np.where(is_named, (rules.jump * np.abs(jump) + gap) * shown, 0.0)
        cost = np.where(is_behind, _NEVER, cost)
        # One column may be a crossing of noise; it must not forbid anything for ever.
        cost = np.minimum(cost, np.where(pair.weight >= 2, _NEVER, 4.0)[:, None, None])
        weight = np.minimum(pair.weight, 40).astype(np.float64)
        groups.append(_Pairs(pair.first, pair.second, cost, weight, jump, np.full(len(weight), pair.reach == 1)))
    return _joined(groups, slots)


def _is_plain(best: I64, pairs: _Pairs, candidates: _Candidates, lines: int) -> bool:
    """All neighbours count up by one at like heights: nothing could be one off."""
    number = candidates.label[np.arange(len(best)), best]
    if (number == NONE).any() or len(np.unique(number)) != lines:
        return False
    return bool((pairs.cost[pairs.chosen(best)] < 0.3 * pairs.weight).all())


def _neighbours_along(node: I64, along: I64, across: F64, height: _Heights, pitch_px: float, count: int) -> _Pairs:
    """Fragments that follow each other along the lines: the surface rather goes on at its height."""
    first = np.searchsorted(node, np.arange(count))
    last = np.append(first[1:], len(node)) - 1
    slots = height.label.shape[1]
    reach = 4.0 * pitch_px
    gap = along[first][None, :] - along[last][:, None]
    drift = np.abs(across[first][None, :] - across[last][:, None])
    is_near = (gap > 0) & (gap < reach) & (drift < 1.3 * pitch_px)
    if not is_near.any():
        return _joined([], slots)
    rank = np.where(is_near, gap + drift, np.inf)
    # The three nearest that may follow.
    nearest = np.argsort(rank, axis=1, kind="stable")[:, :3]
    source = np.repeat(np.arange(count), nearest.shape[1])
    target = nearest.reshape(-1)
    keep = is_near[source, target]
    source, target = source[keep], target[keep]
    label_a, label_b = height.label[source], height.label[target]
    z_a = height.z_mm[np.maximum(label_a, 0), last[source][:, None]]
    z_b = height.z_mm[np.maximum(label_b, 0), first[target][:, None]]
    jump = np.abs(z_a[:, :, None] - z_b[:, None, :]) / height.step_mm
    # A line that goes on without a jump is the same one; after a jump this says little.
    strength = np.where(drift[source, target] < 0.05 * pitch_px, 3.0, 1.0) * (1.0 - gap[source, target] / reach)
    is_named = (label_a != NONE)[:, :, None] & (label_b != NONE)[:, None, :]
    cost = np.where(is_named, strength[:, None, None] * np.minimum(jump, 1.0), 0.0)
    n = len(source)
    return _Pairs(source, target, cost, np.ones(n), np.zeros_like(cost), np.zeros(n, bool))


def _joined(groups: list[_Pairs], slots: int) -> _Pairs:
    none, table = np.zeros(0, np.int64), np.zeros((0, slots, slots))
    groups = [_Pairs(none, none, table, np.zeros(0), table, np.zeros(0, bool)), *groups]
    return _Pairs(*(np.concatenate([getattr(g, entry.name) for g in groups]) for entry in fields(_Pairs)))


def _propagate(unary: F64, groups: tuple[_Pairs, ...], turns: int = 60) -> tuple[I64, F64]:
    """Minimum-sum belief propagation: best slot per node and its lead over the second best."""
    first = np.concatenate([g.first for g in groups])
    second = np.concatenate([g.second for g in groups])
    cost = np.minimum(np.concatenate([g.cost for g in groups]), _NEVER).astype(np.float32)
    source = np.concatenate([first, second])
    target = np.concatenate([second, first])
    # Cost as seen by each directed message: [message, slot of source, slot of target].
    towards = np.concatenate([cost, cost.transpose(0, 2, 1)])
    labels = unary.shape[1]
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


def _energy(slot: I64, unary: F64, groups: tuple[_Pairs, ...]) -> float:
    total = float(unary[np.arange(len(slot)), slot].sum())
    for group in groups:
        total += float(group.cost[group.chosen(slot)].sum())
    return total


def _shifted_patches(
    best: I64, lead: F64, unary: F64, candidates: _Candidates, pairs: _Pairs, follow: _Pairs, least: float
) -> tuple[I64, F64]:
    """Let whole patches change their numbers together, and bound the leads by what such a change costs.

    Fragments beside each other hold each other's numbers firmly; whether all of them are one off is
    a question that single fragments cannot answer, and belief propagation on loops answers too surely.
    """
    none = candidates.slots - 1
    groups = (pairs, follow)
    best = best.copy()
    energy = _energy(best, unary, groups)
    gaps = np.full(len(unary), np.inf)
    nodes = np.arange(len(unary))
    lines = candidates.slot.shape[1]
    for _ in range(4):
        gaps[:] = np.inf
        moved = False
        for members in _patches(best, pairs, candidates):
            for shift in (-1, 1, -2, 2):
                number = candidates.label[nodes[members], best[members]] + shift
                inside = (number >= 0) & (number < lines)
                wanted = candidates.slot[nodes[members], np.clip(number, 0, lines - 1)]
                # What cannot bear its new number bears none.
                wanted = np.where(inside & (wanted >= 0), wanted, none)
                if (wanted == none).all():
                    continue
                trial = best.copy()
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
    return float(pairs.weight[(members[pairs.first] != members[pairs.second]) & pairs.is_beside].sum())


def _patches(best: I64, pairs: _Pairs, candidates: _Candidates) -> list[Bool]:
    """Sets of fragments that hang together: neighbours whose numbers follow each other at like heights.

    What passes for like heights is tried at several levels, because a patch one number off may lie
    nearly flush with what surrounds it.
    """
    count = len(best)
    number = candidates.label[np.arange(count), best]
    a, b = number[pairs.first], number[pairs.second]
    is_next = (a != NONE) & (b == a + 1) & pairs.is_beside
    jump = np.where(is_next, pairs.jump[pairs.chosen(best)], np.inf)
    found: dict[bytes, Bool] = {}
    for level in (0.05, 0.12, 0.3):
        patch = np.arange(count)
        joined = np.abs(jump) < level
        for first, second in zip(pairs.first[joined], pairs.second[joined], strict=True):
            old, new = patch[second], patch[first]
            if old != new:
                patch[patch == old] = new
        for name in np.unique(patch):
            members = (patch == name) & (number != NONE)
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
        pair, weight = np.unique(np.stack([node[upper[wrong]], node[lower[wrong]]]), axis=1, return_counts=True)
        a, b = pair[:, int(np.argmax(weight))]
        number[a if lead[a] < lead[b] else b] = NONE
    return number
