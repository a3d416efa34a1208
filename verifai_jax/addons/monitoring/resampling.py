"""Recordings on an even clock that keep every recorded sample.

    resample(Trace({"x": xs}, times=ts), dt=0.1, method="hold")

Samples recorded between two samples of the new clock are kept (`Trace.between`) and used for
verdicts, so a spike between two samples is not lost.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, Literal, TypeAlias

import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from verifai_jax.addons.monitoring.stamps import merged
from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_seconds, format_time
from verifai_jax.core.values.gaps import has_truths
from verifai_jax.core.values.trace import Trace, check_period
from verifai_jax.mtl.setting import resolution_of, since_first

Method = Literal["hold", "linear"]
Missing = Literal["hold", "drop", "interpolate"]
Ways: TypeAlias = Missing | float | Sequence[Missing | float]
"""How to treat gaps, and numbers that stand for one."""
Treatment: TypeAlias = Ways | Mapping[str, Ways] | None
MAX_SAMPLES = 100_000_000
"""Samples that a resampled trace may have: a signal of so many takes 800 MB in double precision."""


def resample(trace: Trace, dt: float, method: Method) -> Trace:
    """Resample signals on an even clock, from the first sample time to the last.

    Verdicts on the result use both the new samples and the recorded ones: those recorded between
    new samples are kept in `between`. But windows are counted in periods of the clock, so each end
    of one may be off by less than a period, as a note says; `judge` and `dense_robustness` decide
    at the recorded times. A missing value (NaN) is not a sample of its signal, as in a
    log of topics that arrive at different times: `"hold"` keeps the signal's last value, with a
    note; `"linear"` leaves a gap.

    **Arguments:**
    - `trace`: a trace with `times` or another period; NumPy or JAX arrays, not under `jit`.
    - `dt`: the new sampling period in seconds.
    - `method`: `"hold"` keeps each value until the next sample; `"linear"` interpolates.
    **Raises:** `ValueError` for a period that is not positive or makes more than 100 million
    samples, an unknown method, or sample times that do not increase or are not finite.
    """
    if method not in ("hold", "linear"):
        raise ValueError(f"method is 'hold' or 'linear'; got {method!r}")
    check_period(dt)
    trace = check_holes(recorded_samples(trace), None)
    check_increasing(np.asarray(trace.clock() if trace.times is None else trace.times))
    elapsed, resolution = np.asarray(trace.clock()), 0.0
    if trace.times is not None:
        elapsed, resolution = since_first(np.asarray(trace.times))
    # A sample due at `t` counts from `t` on, whatever the last digit of the clock says.
    tolerance = 1e-6 * dt + resolution
    with np.errstate(over="ignore"):
        steps = np.floor((elapsed[-1] * (1 + 1e-9) + 1e-9 * dt + resolution) / dt)
    if not steps < MAX_SAMPLES:
        raise ValueError(
            f"resampling {format_seconds(elapsed[-1])} every {format_seconds(dt)} makes "
            f"{steps + 1:z.3g} samples, more than {MAX_SAMPLES}: take a longer period"
        )
    clock = dt * np.arange(int(steps) + 1)
    index = np.searchsorted(elapsed, clock + tolerance, side="right") - 1
    cell = np.searchsorted(clock, elapsed + tolerance, side="right") - 1
    on_clock = np.abs(clock[cell] - elapsed) <= tolerance
    passed = np.flatnonzero(~((index[cell] == np.arange(len(elapsed))) & on_clock))
    signals, inner, notes = {}, {}, dict(trace.notes)
    if len(passed):
        late = float(np.max(elapsed[passed] - clock[cell[passed]]))
        notes[
            f"samples are up to {format_seconds(late, 4)} later than the clock of "
            f"{format_seconds(dt)}: by so much each end of a window may be off"
        ] = len(passed)
    for name, recorded in trace.signals.items():
        values = np.asarray(recorded)
        if trace.is_truth(name) or method == "hold":
            if (missing := gaps(values)).any():
                notes[hold_note(name, missing)] = int(missing.sum())
            values = held(values)
            signals[name], inner[name] = values[index], values[passed]
        else:
            signals[name] = _interpolated(values, elapsed, clock, index, tolerance)
            inner[name] = filled(values, elapsed)[passed]
    between = None
    if len(passed):
        positions = _positions(cell[passed], len(clock))
        times = np.concatenate([clock, elapsed[passed]])[positions]
        between = Trace(
            {name: np.concatenate([signals[name], inner[name]])[positions] for name in signals},
            times=times,
        )
    about = {"status": trace.status, "notes": notes, "units": trace.units, "truths": trace.truths}
    return Trace(signals, dt=float(dt), between=between, **about)


def recorded_samples(trace: Trace) -> Trace:
    """Return the samples that count, each once, those between others among them."""
    trace = trace.trim()
    if trace.between is None:
        return trace
    fine = trace.finely()
    new = np.append(True, np.diff(fine.clock()) > 0)
    signals = {name: np.asarray(signal)[new] for name, signal in fine.signals.items()}
    return replace(trace, signals=signals, dt=None, times=fine.clock()[new], between=None)


def _positions(cells: Int[np.ndarray, " passed"], count: int) -> Int[np.ndarray, " positions"]:
    """Return which sample stands at each position, with as many positions in each period.

    Those of the clock (`count`) have the first numbers, those passed over (in `cells`) the next.
    """
    rank = np.arange(len(cells)) - np.searchsorted(cells, cells)
    # A power of two, less one, so that recordings share compiled monitors.
    each = (1 << int(rank.max() + 1).bit_length()) - 1
    if count * (each + 1) > MAX_SAMPLES:
        raise ValueError(
            f"resampling to {count} samples leaves up to {int(rank.max()) + 1} recorded samples "
            "between two of them, more than can be evaluated: take a shorter period, or cut the "
            "recording into parts"
        )
    positions = np.repeat(np.arange(count)[:, None], each, axis=1)
    positions[cells, rank] = count + np.arange(len(cells))
    # The sample before is repeated where fewer lie in a period.
    return np.maximum.accumulate(positions, axis=1).reshape(-1)


def gaps(values: np.ndarray) -> np.ndarray:
    """Return the rows in which a signal, or a component of a vector, has no value."""
    if values.dtype.kind != "f":
        return np.zeros(len(values), bool)
    return np.asarray(np.any(np.isnan(values).reshape(len(values), -1), axis=1))


def hold_note(name: str, missing: np.ndarray) -> str:
    """Return the note on a signal whose value is missing in some rows, and held there."""
    rows = f"{missing.sum()} of {len(missing)} rows"
    return f"signal {name!r} has no value in {rows}: its last one is held there"


def held(values: np.ndarray) -> np.ndarray:
    """Return each column with its last value in gaps; a gap remains before the first value."""
    if not gaps(values).any():
        return values
    columns = values.reshape(len(values), -1)
    known = np.where(np.isnan(columns), 0, np.arange(len(values))[:, None])
    last = np.maximum.accumulate(known, axis=0)
    return np.take_along_axis(columns, last, axis=0).reshape(values.shape)


def _interpolated(
    values: np.ndarray, elapsed: np.ndarray, clock: np.ndarray, index: np.ndarray, tolerance: float
) -> np.ndarray:
    following = np.minimum(index + 1, len(elapsed) - 1)
    gap, ahead = elapsed[following] - elapsed[index], clock - elapsed[index]
    share = np.clip(np.where(gap > 0, ahead / np.where(gap > 0, gap, 1), 0), 0, 1)
    share = np.where(np.abs(ahead) <= tolerance, 0, share)
    weight = share.reshape((-1,) + (1,) * (values.ndim - 1))
    here, there = values[index], values[following]
    # Not a weighted sum, which would spread the NaN of a neighbour with no weight.
    return np.where(weight == 0, here, here + weight * (there - here))


def filled(values: np.ndarray, elapsed: Float[np.ndarray, " time"]) -> np.ndarray:
    """Return a signal with its gaps interpolated linearly between its own neighbours.

    Rows in which a signal has no value are ignored; the gap shows only at samples of the clock.
    """
    if not gaps(values).any():
        return values
    columns = []
    for column in values.reshape(len(values), -1).T:
        known = np.flatnonzero(~np.isnan(column))
        columns.append(np.interp(elapsed, elapsed[known], column[known]) if len(known) else column)
    return np.stack(columns, axis=1).reshape(values.shape)


def joined(
    stamps: Sequence[tuple[np.ndarray, Fraction]], parts: Sequence[dict[str, np.ndarray]]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Merge the instants of several clocks, and return columns with gaps at instants of others.

    **Arguments:**
    - `stamps`: times of each clock in seconds, and their origin.
    """
    origin = min(start for _, start in stamps)
    rounded = [resolution_of(seconds) for seconds, _ in stamps]
    since = [np.asarray(seconds, float) + float(start - origin) for seconds, start in stamps]
    clocks = merged(since, rounded)
    union = np.unique(np.concatenate(clocks))
    values = {}
    for clock, part in zip(clocks, parts, strict=True):
        rows = np.searchsorted(union, clock)
        for name, column in part.items():
            shape = (len(union), *column.shape[1:])
            truths = np.ma.masked_all(shape, bool)
            values[name] = truths if has_truths(column) else np.full(shape, np.nan)
            with np.errstate(invalid="ignore"):  # A NaN of a damaged file may be a signalling one.
                values[name][rows] = column
    return union, values


def treated(trace: Trace, max_gap: float | None, missing: Treatment) -> Trace:
    """Return a recording with its sentinels as gaps, notes on holes, and gaps filled or left out.

    **Raises:** `ValueError` for a hole longer than `max_gap` seconds; see `without_gaps`.
    """
    given = missing if isinstance(missing, Mapping) else dict.fromkeys(trace.signals, missing)
    check_names("signal", given, trace.signals)
    signals, notes = dict(trace.signals), dict(trace.notes)
    ways: dict[str, Any] = {}
    for name, several in given.items():
        listed: Any = several if isinstance(several, list | tuple) else [several]
        for way in listed:
            if isinstance(way, str):
                ways[name] = way
            elif way is not None and is_number(way) and not trace.is_truth(name):
                array = np.asarray(signals[name])
                gone = array == way
                if gone.any():
                    signals[name] = np.where(gone, np.nan, array)
                    notes[f"signal {name!r} has {gone.sum()} of {way:zg}: no value there"] = 1
            elif way is not None and not is_number(way):
                raise ValueError(f"missing is a way to treat a gap or a number; got {way!r}")
    if notes.keys() != trace.notes.keys():
        trace = replace(trace, signals=signals, notes=notes)
    trace = check_holes(trace, max_gap)
    return without_gaps(trace, ways) if ways else trace


def without_gaps(trace: Trace, missing: Missing | Mapping[str, Missing]) -> Trace:
    """Fill the gaps of signals, or remove the instants with gaps."""
    ways = missing if isinstance(missing, Mapping) else dict.fromkeys(trace.signals, missing)
    check_names("signal", ways, trace.signals)
    check_names("way to treat a gap", ways.values(), ("hold", "drop", "interpolate"))
    signals, notes = {n: np.asarray(s) for n, s in trace.signals.items()}, dict(trace.notes)
    kept = np.ones(trace.length, bool)
    for name, way in ways.items():
        gap = gaps(signals[name])
        if not gap.any():
            continue
        if way == "drop":
            said, kept = "these are left out", kept & ~gap
        elif way == "hold" or trace.is_truth(name):  # A truth value has no values between.
            said, signals[name] = "its last one is held", held(signals[name])
        else:
            filled_in = filled(signals[name], np.asarray(trace.clock()))
            said, signals[name] = "it is interpolated", filled_in
        notes[f"signal {name!r} has no value in {gap.sum()} of {len(gap)} rows: {said} there"] = 1
    if not kept.any():
        raise ValueError(
            "no instant is left: at each instant some signal whose gaps are dropped has a gap"
        )
    signals = {name: signal[kept] for name, signal in signals.items()}
    if trace.times is None and kept.all():
        return replace(trace, signals=signals, notes=notes)
    clock = np.asarray(trace.clock())[kept]
    return replace(trace, signals=signals, notes=notes, times=clock, dt=None)


HOLE = 10.0
"""Usual steps of a signal beyond which a step is a hole."""


def check_holes(trace: Trace, max_gap: float | None) -> Trace:
    """Return a trace with notes on times without a value of a signal, far longer than its period.

    **Raises:** `ValueError` for one longer than `max_gap` seconds.
    """
    if isinstance(trace.times, Tracer):
        return trace
    times, notes, seen = np.asarray(trace.clock()), dict(trace.notes), set[bytes]()
    for name, signal in trace.signals.items():
        known = ~gaps(np.asarray(signal))
        steps, own = np.diff(times[known]), times[known]
        if not len(steps) or known.tobytes() in seen:
            continue
        seen.add(known.tobytes())
        k, usual = int(np.argmax(steps)), float(np.median(steps))
        first, last = (format_time(t) for t in own[k : k + 2])
        lasts = format_seconds(float(steps[k]))
        what = f"signal {name!r} has no value from {first} s to {last} s, {lasts}"
        if max_gap is not None and steps[k] > max_gap:
            raise ValueError(f"{what}: more than max_gap, which is {format_seconds(max_gap)}")
        if steps[k] > HOLE * usual:
            hour = " (an hour is skipped where local times change to summer time)"
            summer = hour if abs(steps[k] - 3600) <= 2 * usual else ""
            note = f"{what}, where {format_seconds(usual)} is usual{summer}"
            notes[note] = int(np.sum(steps > HOLE * usual))
    return replace(trace, notes=notes)


def check_increasing(times: np.ndarray) -> None:
    """Raise `ValueError` that names a row whose time is not finite, or not after its predecessor.

    Rows are counted from 1.
    """
    if not np.all(np.isfinite(times)):
        k = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"sample times must be finite; row {k + 1} has {times[k]:zg} s")
    # Compared, and not subtracted: small integers would wrap.
    rises = times[1:] > times[:-1]
    if not np.all(rises):
        k = int(np.argmin(rises))
        first, second = (format_time(float(t)) for t in times[k : k + 2])
        hour = "; an hour comes twice where local times change from summer time"
        raise ValueError(
            f"sample times must increase; row {k + 1} has {first} s and row {k + 2} {second} s"
            f"{hour if 3000 < float(times[k]) - float(times[k + 1]) <= 3600 else ''}"
        )
