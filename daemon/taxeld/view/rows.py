"""What changes with time, row by row: sent at once, or many rows together.

Rerun takes 0.15 ms for a row and not much more for some hundreds of them in columns, so what is
replayed faster than it happened waits for its neighbours.
"""

from collections.abc import Sequence
from itertools import chain
from typing import Any

import rerun as rr
from numpy.typing import NDArray

Field = Sequence[Any] | NDArray[Any]  # of one component, an item an instance


class Rows:
    """Of the entities of one recording stream, on one time line."""

    def __init__(self, stream: rr.RecordingStream, timeline: str, *, at_once: bool) -> None:
        """`at_once`: no row waits for `flush`."""
        self.t = 0.0  # Unix time [s] of the rows that come
        self._stream, self._timeline, self._at_once = stream, timeline, at_once
        self._waiting: dict[tuple[str, Any, tuple[str, ...]], list[tuple[float, list[Field]]]] = {}

    def put(self, entity: str, kind: Any, **fields: Field) -> None:
        """A row of an archetype `kind`; what it does not name stays as it was."""
        if self._at_once:
            self._stream.set_time(self._timeline, timestamp=self.t)
            self._stream.log(entity, kind.from_fields(**fields))
            return
        rows = self._waiting.setdefault((entity, kind, tuple(fields)), [])
        rows.append((self.t, list(fields.values())))

    def flush(self) -> None:
        """Send what waits."""
        for (entity, kind, names), rows in self._waiting.items():
            self._send(entity, kind, names, rows)
        self._waiting.clear()

    def _send(
        self, entity: str, kind: Any, names: tuple[str, ...], rows: list[tuple[float, list[Field]]]
    ) -> None:
        columns: list[Any] = []
        for k, name in enumerate(names):
            given = [fields[k] for _, fields in rows]
            column = kind.columns(**{name: list(chain.from_iterable(given))})
            columns += column.partition([len(field) for field in given])
        times = rr.TimeColumn(self._timeline, timestamp=[t for t, _ in rows])
        self._stream.send_columns(entity, indexes=[times], columns=columns)
