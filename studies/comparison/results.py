# SPDX-License-Identifier: Apache-2.0
"""The results of a comparison: one entry a method and sensor, as data and as a file."""

from collections.abc import Iterable, Sequence
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from studies.comparison.cells import Disturbance, PLANTS, Sensor
from studies.comparison.evaluation import METHODS, Tuned
from studies.comparison.scores import Scores


class Entry(NamedTuple):
    """A tuned method and its scores, one for each disturbance of the sensor."""

    sensor: Sensor
    method: str
    tuned: Tuned
    scores: list[Scores]


class Cell(NamedTuple):
    """One row of the tables."""

    sensor: Sensor
    disturbance: str

    @property
    def plant(self) -> str:
        """Return the plant's name in words."""
        return PLANTS[self.sensor.plant].text

    @property
    def kind(self) -> Disturbance:
        """Return the kind of d."""
        return self.sensor.case.disturbances[self.disturbance]


Table = dict[Cell, dict[str, Scores]]
"""Scores by cell and method, both in the order of the comparison."""

Chosen = dict[Cell, dict[str, tuple[str, Scores]]]
"""By cell and kind of method: a method's name and its scores."""


class Results(NamedTuple):
    """
    All that a run of the comparison has found.

    Attributes
    ----------
    entries : list of Entry
    seconds : dict
        Time a sample by method.
    trials, training : int
        Trials of each tuning, and recordings that each saw.
    bounds : dict
        Lower bound on the error for step disturbances, by sensor; see methods/steps_bound.py.

    """

    entries: list[Entry]
    seconds: dict[str, float]
    trials: int
    training: int
    bounds: dict[Sensor, float]

    def table(self, methods: Sequence[str]) -> Table:
        """Return the scores by cell and method."""
        table: Table = {}
        for name in methods:
            for entry in self.entries:
                if entry.method == name:
                    for disturbance, s in zip(
                        entry.sensor.disturbances, entry.scores, strict=True
                    ):
                        table.setdefault(Cell(entry.sensor, disturbance), {})[name] = s
        return dict(sorted(table.items(), key=lambda item: _place(item[0])))

    def best_of_kinds(self) -> Chosen:
        """Return for each cell the method of each kind whose error in training is smallest."""
        trained = {(e.sensor, e.method): e.tuned.training for e in self.entries}
        chosen: Chosen = {}
        for cell, scores in self.table(list(METHODS)).items():
            for name in sorted(scores, key=lambda name, c=cell: trained[c.sensor, name]):
                kind = METHODS[name].kind
                chosen.setdefault(cell, {}).setdefault(kind, (name, scores[name]))
        return chosen

    def with_new(self, new: 'Results') -> 'Results':
        """Return these results with the entries and times of `new` in place of the old ones."""
        by_key = {(e.sensor, e.method): e for e in new.entries}
        entries = [by_key.get((e.sensor, e.method), e) for e in self.entries]
        return self._replace(entries=entries, seconds=self.seconds | new.seconds)

    def find(self, sensor: Sensor, method: str) -> Entry | None:
        """Return an entry."""
        found = (e for e in self.entries if (e.sensor, e.method) == (sensor, method))
        return next(found, None)


def _place(cell: Cell) -> tuple[Any, ...]:
    s = cell.sensor
    return (
        list(PLANTS).index(s.plant),
        s.timing != 'even',
        s.timing,
        list(s.case.disturbances).index(cell.disturbance),
        -s.rate,
        s.noise,
    )


def save(results: Results, path: Path) -> None:
    """Write results; infinity becomes null, because JSON has no infinity."""
    rows = [
        {
            **e.sensor._asdict(),
            'method': e.method,
            **e.tuned._asdict(),
            'scores': [s._asdict() for s in e.scores],
        }
        for e in results.entries
    ]
    data = {
        'trials': results.trials,
        'training_recordings': results.training,
        'seconds_a_sample': results.seconds,
        'bounds': [{**s._asdict(), 'd': bound} for s, bound in results.bounds.items()],
        'entries': rows,
    }
    text = json.dumps(_finite(data), indent=None, separators=(',', ':'), allow_nan=False)
    path.write_text(text.replace('{"plant"', '\n{"plant"') + '\n', encoding='utf-8')


def load(path: Path) -> Results:
    """Read what `save` wrote."""
    data = json.loads(path.read_text(encoding='utf-8'))
    entries = []
    for row in data['entries']:
        sensor = _sensor(row)
        tuned = Tuned(row['values'], row['readout'], _number(row['training']))
        judged = [Scores(*(_number(s[k]) for k in Scores._fields)) for s in row['scores']]
        entries.append(Entry(sensor, row['method'], tuned, judged))
    bounds = {_sensor(row): row['d'] for row in data['bounds']}
    return Results(
        entries, data['seconds_a_sample'], data['trials'], data['training_recordings'], bounds
    )


def _sensor(row: dict[str, Any]) -> Sensor:
    return Sensor(
        row['plant'], tuple(row['disturbances']), row['noise'], row['rate'], row['timing']
    )


def _number(x: float | None) -> float:
    return float('inf') if x is None else x


def _finite(data: Any) -> Any:
    """Round to the digits that can be reproduced; infinity and NaN become None."""
    if isinstance(data, float):
        return float(f'{data:.6g}') if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, Iterable) and not isinstance(data, str):
        return [_finite(value) for value in data]
    return data
