"""Estimates things from sights: stays at places, linked into things with a history.

A label that is a small share of another's detections at a place, and is never in one message with
it there, is that other thing under a wrong name. The stays that are left are linked into as few
things as explain them: a stay that was seen to have ended may go on elsewhere. A label of people or
pets, or one whose stays are many and short, moves by itself.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.sights import STOREY_MM, Score, Spot, apart_m
from ros2_memory.core.arrays import (
    Flags,
    Ints,
    bounds_of,
    concatenated,
    distinct_rows,
    in_ranges,
    range_numbers,
    rows_by,
    stable_order,
)
from ros2_memory.things.blindness import without_blind_looks
from ros2_memory.things.identity import lasting_ids
from ros2_memory.things.instances import (
    Estimate,
    Instance,
    Mover,
    PlacedStay,
    Tally,
    count_labels,
    count_names,
)
from ros2_memory.things.labels import STATES, Labels, moves_by_itself
from ros2_memory.things.observations import FEWEST, Observations, lowest_bin
from ros2_memory.things.places import GATE_MM, MAX_PLACES, MIDDLE, places_of, stays_in
from ros2_memory.things.presence import Evidence, evidence_at, stays_at
from ros2_memory.things.stays import (
    LabelGroup,
    end_where_carried_away,
    groups_in,
    placed_stays,
    remove_false_stays,
)
from ros2_memory.things.synonyms import with_synonyms

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ros2_memory.analysis.sights import Floats
    from ros2_memory.columns.sights import JoinedSights
    from ros2_memory.core.timebase import Ns


_FEWEST_OF_MOVERS: Final = 10
_SEVERAL_SHARE: Final = 0.1
"""Where more of the slices have several of a label at one place, several things stand there."""
_FEWEST_IN_PART: Final = 10
_SEVERAL_IN_PART: Final = 0.5
"""So they do where more have several between the first and the last decile of such slices."""
_SPOTS_AT_ONCE: Final = 16_384
"""About how many spots of labels are looked at together."""
_RESTLESS_MOVES: Final = 6
_RESTLESS_SHARE: Final = 0.2


def estimate(
    sights: JoinedSights,
    labels: Labels,
    min_score: float = 0.0,
    go_on: Callable[[], None] = lambda: None,
) -> Estimate:
    """Returns the things in sights.

    Detections with a score below `min_score`, to 0.05, do not count. `go_on` is called again and
    again; its errors end the estimate.
    """
    observed = Observations(sights, labels, min_score, go_on)
    sights, blind_times = without_blind_looks(observed, labels)
    if blind_times:
        observed = Observations(sights, labels, min_score, go_on)
    names = _names_to_show(sights, labels)
    keys = with_synonyms(sights, observed.counts, labels, go_on)
    groups = groups_in(observed, keys)
    _add_places(groups, observed)
    for batch in _batches(groups):
        _add_stays(batch, observed)
    remove_false_stays(groups, observed, keys)
    instances, movers = _linked_things(groups, observed)
    for instance in instances:
        rows = np.concatenate([stay.spots for stay in instance.stays])
        label_counts = count_labels(sights, observed.counts, rows)
        instance.labels = count_names(label_counts, labels, names)
        instance.id = sights.ids[instance.stays[0].id]
    instances.sort(key=lambda thing: (thing.label, thing.stays[0].first, thing.stays[0].x))
    counting = np.flatnonzero(sights.scores[:, Score.BIN] >= lowest_bin(min_score))
    scores = (sights.scores[counting, name] for name in Score)
    result = Estimate(
        topics=sights.topics,
        labels=sights.labels,
        spots=sights.spots,
        unplaced=sights.unplaced,
        scores=Tally.of(len(sights.spots), *scores),
        hits=observed.hits,
        looks=observed.cells.looks,
        blind=blind_times,
        instances=instances,
        movers=movers,
        counts=observed.counts,
        carried=observed.carried,
        poor=observed.poor,
        names=names,
        evidence=_evidence_of(instances, groups),
        unplaced_of={group.key: group.unplaced for group in groups},
        crowded=frozenset(names[group.key] for group in groups if group.is_crowded),
    )
    for instance in instances:
        instance.looks, instance.missed_by = result.missing(instance, instance.stays[-1])
    return result


def _batches(groups: Sequence[LabelGroup]) -> Iterator[list[LabelGroup]]:
    """Yields the groups in batches of about `_SPOTS_AT_ONCE` spots."""
    spots_before = np.cumsum([0, *(len(group.rows) for group in groups)])
    numbers = (spots_before // _SPOTS_AT_ONCE).tolist()
    for _, numbered_groups in groupby(zip(numbers, groups, strict=False), itemgetter(0)):
        yield [group for _, group in numbered_groups]


def _linked_things(
    groups: Sequence[LabelGroup], observed: Observations
) -> tuple[list[Instance], list[Mover]]:
    """Returns the instances that explain the stays of each group, and the labels that move."""
    instances: list[Instance] = []
    movers: list[Mover] = []
    _mark_changed_states(groups)
    for group in groups:
        observed.go_on()
        linked = _link(group, observed)
        _add_poorly_localised(linked, group, observed)
        moves = len(group.stays) - len(linked)
        is_restless = moves >= _RESTLESS_MOVES and moves > _RESTLESS_SHARE * len(group.rows)
        if not is_restless and not moves_by_itself(group.key):
            instances += linked
            continue
        counts = observed.counts[group.rows]
        if counts[counts >= FEWEST].sum() >= _FEWEST_OF_MOVERS:
            movers.append(Mover(group.key, group.epoch, group.rows))
    return instances, movers


def _mark_changed_states(groups: Sequence[LabelGroup]) -> None:
    """Marks the stays that end in another state of the thing; see `PlacedStay.has_changed`."""
    of_kind: defaultdict[tuple[str, int], list[tuple[str, PlacedStay]]] = defaultdict(list)
    for group in groups:
        kind, _, state = group.key.rpartition(" ")
        if kind and state in STATES:
            of_kind[kind, group.epoch] += ((state, stay) for stay in group.stays)
    for stays_of_kind in of_kind.values():
        states, stays = zip(*stays_of_kind, strict=True)
        middles, first = _middles(stays), np.array([stay.first for stay in stays])
        for state, stay in stays_of_kind:
            is_after = (np.array(states) != state) & (first > stay.last)
            stay.has_changed = bool((is_after & _are_near(middles, stay)).any())


def _evidence_of(
    instances: Sequence[Instance], groups: Sequence[LabelGroup]
) -> dict[tuple[str, int, int], Evidence]:
    """Returns the evidence for the places of things: at most other places, detections are false."""
    group_of = {(group.key, group.epoch): group for group in groups}
    evidence: dict[tuple[str, int, int], Evidence] = {}
    for instance in instances:
        group = group_of[instance.key, instance.epoch]
        for place in {stay.place for stay in instance.stays}:
            if (group.key, group.epoch, place) not in evidence:
                evidence[group.key, group.epoch, place] = group.evidence.at_place(place)
    return evidence


def _add_places(groups: Sequence[LabelGroup], observed: Observations) -> None:
    """Adds to each group its places, with a new one each time that a thing was moved a little."""
    single: list[tuple[LabelGroup, Ints]] = []
    for group in groups:
        if moves_by_itself(group.key):
            continue
        observed.go_on()
        there = [*_places_of_group(group, observed)]
        rows = concatenated(rows for rows, _ in there)
        observed.ids[rows] = lasting_ids(observed.sights, rows, [len(part) for part, _ in there])
        for rows, is_shared in there:
            for number in np.unique(observed.ids[rows]).tolist():
                part = rows[observed.ids[rows] == number]
                if is_shared and not number:
                    group.places.append(part)
                elif observed.counts[part].sum() >= FEWEST:
                    single.append((group, part))
    if not single:
        return
    thing = range_numbers([len(rows) for _, rows in single])
    rows = np.concatenate([rows for _, rows in single])
    spots = observed.sights.spots[rows]
    steps = stays_in(spots, observed.counts[rows], observed.side[rows], thing)
    for (group, rows), step in zip(single, steps, strict=True):
        group.places += [rows[step == number] for number in range(int(step.max()) + 1)]


def _places_of_group(group: LabelGroup, observed: Observations) -> Iterator[tuple[Ints, bool]]:
    """Yields the spots at each place, and whether several things of the label stand there."""
    rows = observed.firm(group.rows)
    spots = observed.sights.spots
    names = (Spot.X, Spot.Y, Spot.Z, Spot.SLICE)
    x, y, z, slices = (spots[rows, name] for name in names)
    place = np.full(len(rows), -1, np.int64)
    # A floor ends where heights leave a gap.
    by_height = stable_order(z)
    floors = np.split(by_height, np.flatnonzero(np.diff(z[by_height]) > STOREY_MM) + 1)
    for floor in floors:
        on_floor = places_of(x[floor], y[floor], observed.counts[rows[floor]], slices[floor])
        group.is_crowded |= int(on_floor.max(initial=-1)) + 1 == MAX_PLACES
        place[floor] = np.where(on_floor < 0, -1, on_floor + place.max(initial=-1) + 1)
    rows, place = rows[place >= 0], place[place >= 0]
    of_message = (spots[rows, name] for name in (Spot.SLICE, Spot.TOPIC, Spot.LABEL))
    seen_at, number = distinct_rows((place, *of_message))
    are_shared = _are_shared(seen_at[:, 0], np.bincount(number))
    places = rows_by(place, len(are_shared))
    for positions, is_shared in zip(places, are_shared.tolist(), strict=True):
        yield rows[positions], is_shared


def _are_shared(place: Ints, spots: Ints) -> Flags:
    """Returns at which places several things of a label stand together: slices have several spots.

    That holds in all of time, or in one part of it. `spots` has the number of spots in each slice
    of a place, in order of time; places are in order.
    """
    sizes = np.bincount(place)
    are_shared: Flags = np.bincount(place, spots - 1) > _SEVERAL_SHARE * sizes
    begins = np.cumsum(sizes) - sizes
    often = np.bincount(place, spots > 1) >= _FEWEST_IN_PART
    for number in np.flatnonzero(often & ~are_shared).tolist():
        spots_there = spots[begins[number] : begins[number] + sizes[number]]
        several = np.flatnonzero(spots_there > 1)
        begin, end = np.percentile(several, MIDDLE)
        inside = np.count_nonzero((several >= begin) & (several <= end))
        are_shared[number] = inside > _SEVERAL_IN_PART * (end - begin)
    return are_shared


def _add_stays(groups: Sequence[LabelGroup], observed: Observations) -> None:
    """Adds to each group the stays at its places, and the evidence for them.

    Places are numbered in the order of the groups.
    """
    spots_of_places = [rows for group in groups for rows in group.places]
    if not spots_of_places:
        return
    spots, rows = observed.sights.spots, np.concatenate(spots_of_places)
    place = range_numbers([len(there) for there in spots_of_places])
    group_of = range_numbers([len(group.places) for group in groups])
    n = observed.counts[rows]
    sums = [np.bincount(place, n * spots[rows, column]) for column in (Spot.X, Spot.Y)]
    centres = np.stack(sums, axis=1) / np.bincount(place, n)[:, None]
    sizes, look, n_of_look = observed.hits.rows_of(rows)
    hits = np.stack((np.repeat(spots[rows, Spot.SLICE], sizes), look, n_of_look), axis=1)
    evidence = evidence_at(
        observed.cells,
        observed.fields,
        centres,
        hits,
        np.repeat(place, sizes),
        unplaced=[group.unplaced for group in groups],
        label=group_of,
    )
    observed.go_on()
    stays = [*stays_at(observed.cells, evidence)]
    # The spots of a place are in the order of their slices: those of a stay are a range.
    width = len(observed.sights.epochs)
    keys = place * width + spots[rows, Spot.SLICE]
    bounds = [
        (stay.place * width + stay.first_slice, stay.place * width + stay.last_slice + 1)
        for stay in stays
    ]
    begin, end = np.searchsorted(keys, bounds_of(bounds))
    for group in groups:
        group.evidence = evidence
    for stay in placed_stays(observed, stays, rows[in_ranges(begin, end - begin)], end - begin):
        groups[group_of[stay.place]].stays.append(stay)
    for group in groups:
        end_where_carried_away(group, observed)


def _link(group: LabelGroup, observed: Observations) -> list[Instance]:
    """Links the stays of a label into as few things as explain them.

    A thing goes on to its next stay after one that was seen to end, without the thing at its place.
    Once a label is known to be moved, a thing may also have left a place that nobody looked at, but
    not all of several that stand there.
    """
    if not group.stays:
        return []
    instances = _chain_stays(group, group.stays, proven=True)
    if any(
        apart_m(thing.stays[0].at, stay.at) * 1000 > GATE_MM
        for thing in instances
        for stay in thing.stays
    ):
        unproven = _chain_stays(group, group.stays, proven=False)
        parts = _split_around_others(group.stays, observed)
        split = _chain_stays(group, parts, proven=False)
        instances = min(instances, unproven, split, key=len)
    for instance in instances:
        instance.stays = _without_overlap(instance.stays, observed)
    return instances


def _chain_stays(group: LabelGroup, stays: Sequence[PlacedStay], *, proven: bool) -> list[Instance]:
    """Returns things whose stays follow one another, at the same place if they can, or near it.

    With `proven` a thing goes on only from a stay that is known to have ended. One that is seen
    near its place again was not elsewhere meanwhile, if another one may have been.
    """
    instances: list[Instance] = []
    stays = sorted(stays, key=lambda stay: stay.firm_first)
    seen_near = np.array([*_seen_near(stays)])
    integers = [
        (stay.first, stay.last, stay.firm_last, stay.place, stay.side_by_side, stay.id)
        for stay in stays
    ]
    first, last, firm_last, place, beside, ids = np.array(integers, np.int64).T
    middles = _middles(stays)
    was_left = np.array([stay.left is not None for stay in stays])
    has_changed = np.array([stay.has_changed for stay in stays])
    newest = np.zeros(len(stays), np.int64)  # by thing, the number of its newest stay
    for number, stay in enumerate(stays):
        lasts = newest[: len(instances)]
        is_near = _are_near(middles[:, lasts], stay)
        # It was seen to end, or is so near that both would be seen together, or has the same id.
        has_ended = was_left[lasts] | is_near & (last[lasts] <= first[number]) | (stay.id > 0)
        if not proven:
            has_ended |= beside[lasts] <= beside[number]
        has_ended &= (ids[lasts] == stay.id) & (is_near | ~has_changed[lasts])
        ended = np.flatnonzero(has_ended & (firm_last[lasts] <= stay.firm_first))
        thing = len(instances)
        if len(ended):
            rows = lasts[ended]
            is_same, is_apart = place[rows] == stay.place, seen_near[rows] < stay.firm_first
            order = np.lexsort((-ended, last[rows], is_apart, is_near[ended], is_same))
            thing = int(ended[order[-1]])
            instances[thing].stays.append(stay)
        else:
            instances.append(Instance(group.key, group.epoch, [stay]))
        newest[thing] = number
    return instances


def _middles(stays: Sequence[PlacedStay]) -> Floats:
    """Returns x, y and z (mm) of stays: three rows."""
    return np.array([(stay.x, stay.y, stay.z) for stay in stays]).T


def _are_near(middles: Floats, stay: PlacedStay) -> Flags:
    """Returns which of some middles are near that of a stay, on its storey."""
    x, y, z = middles
    are_near: Flags = np.hypot(x - stay.x, y - stay.y) <= GATE_MM
    are_near &= np.abs(z - stay.z) <= STOREY_MM
    return are_near


def _seen_near(stays: Sequence[PlacedStay]) -> Iterator[Ns]:
    """Yields for each stay when (ns) the newest stay near it began; it may be the stay itself."""
    middles = _middles(stays)
    x, begun = middles[0], np.array([stay.firm_first for stay in stays], np.int64)
    by_x = stable_order(x)
    begins, ends = (np.searchsorted(x[by_x], x + reach) for reach in (-GATE_MM, GATE_MM))
    for stay, begin, end in zip(stays, begins.tolist(), ends.tolist(), strict=True):
        beside = by_x[begin:end]
        is_near = _are_near(middles[:, beside], stay)
        yield int(begun[beside[is_near]].max(initial=stay.firm_first))


def _split_around_others(stays: Sequence[PlacedStay], observed: Observations) -> list[PlacedStay]:
    """Splits each stay before the spots before which another stay of the label lies elsewhere.

    None of its spots may be seen during the other stay.
    """
    parts: list[PlacedStay] = []
    firm_first, firm_last = bounds_of((stay.firm_first, stay.firm_last) for stay in stays)
    place = np.array([stay.place for stay in stays])
    for stay in stays:
        observed.go_on()
        rows = stay.spots[stable_order(observed.sights.spots[stay.spots, Spot.FIRST])]
        first, last = (observed.sights.spots[rows, name] for name in (Spot.FIRST, Spot.LAST))
        is_inside = (stay.firm_first < firm_first) & (firm_last < stay.firm_last)
        is_inside &= place != stay.place
        before = np.searchsorted(np.sort(last), firm_first[is_inside])
        after = np.searchsorted(first, firm_last[is_inside], side="right")
        is_between = (before == after) & (before > 0) & (after < len(rows))
        cuts = np.unique(after[is_between])
        if not len(cuts):
            parts.append(stay)
            continue
        whole = stay.stay._replace(firm_first=-1, firm_last=-1)
        sizes = np.diff([0, *cuts, len(rows)])
        split = placed_stays(observed, [whole] * len(sizes), rows, sizes)
        split[0].misread_as = stay.misread_as
        split[-1].has_changed = stay.has_changed
        parts += split
    return parts


def _without_overlap(stays: Sequence[PlacedStay], observed: Observations) -> list[PlacedStay]:
    """Returns stays without single sightings at places that the thing had left: they are false."""
    spots = observed.sights.spots
    trimmed: list[PlacedStay] = []
    for number, stay in enumerate(stays):
        rows = stay.spots
        if number + 1 < len(stays):
            end = max(stays[number + 1].firm_first, stay.firm_last)
            rows = rows[spots[rows, Spot.LAST] <= end]
        if number:
            begin = min(stays[number - 1].firm_last, stay.firm_first)
            rows = rows[spots[rows, Spot.FIRST] >= begin]
        if len(rows) < len(stay.spots):
            [placed] = placed_stays(observed, [stay.stay], rows, np.array([len(rows)]))
            trimmed.append(replace(placed, misread_as=stay.misread_as, left=stay.left))
        else:
            trimmed.append(stay)
    return trimmed


def _add_poorly_localised(
    instances: Sequence[Instance], group: LabelGroup, observed: Observations
) -> None:
    """Adds to things the spots that were seen near them while localisation was poor."""
    stays = [stay for instance in instances for stay in instance.stays]
    is_left_out = observed.poor[group.rows] & (len(observed.firm(group.rows)) < len(group.rows))
    if not stays or not is_left_out.any():
        return
    sizes = np.array([len(instance.stays) for instance in instances])
    begins, numbers = np.cumsum(sizes) - sizes, np.arange(len(stays))
    first, (x, y, z) = np.array([stay.first for stay in stays]), _middles(stays)
    for row in group.rows[is_left_out].tolist():
        [spot] = observed.sights.spots[np.array([row])]
        newest = np.maximum.reduceat(np.where(first <= spot[Spot.LAST], numbers, -1), begins)
        newest = newest[newest >= 0]
        newest = newest[np.abs(z[newest] - spot[Spot.Z]) <= STOREY_MM]
        away_mm = np.hypot(x[newest] - spot[Spot.X], y[newest] - spot[Spot.Y])
        if away_mm.min(initial=math.inf) <= GATE_MM:
            stay = stays[newest[away_mm.argmin()]]
            stay.spots = np.sort(np.append(stay.spots, row))
            stay.last = max(stay.last, int(spot[Spot.LAST]))
            stay.count += int(observed.counts[row])


def _names_to_show(sights: JoinedSights, labels: Labels) -> dict[str, str]:
    """Returns the name to show of each key, by how often each of its labels was detected."""
    detections = np.zeros(len(sights.labels), np.int64)
    for table in (sights.spots, sights.unplaced):
        # Both tables have the label and the number in the same columns.
        often = np.bincount(table[:, Spot.LABEL], table[:, Spot.N], len(detections))
        detections += often.astype(np.int64)
    counts: dict[str, dict[str, int]] = {}
    for label, n in zip(sights.labels, detections.tolist(), strict=True):
        if n:
            counts.setdefault(labels.key(label), {})[label] = n
    return {key: labels.name(key, by_label) for key, by_label in counts.items()}
