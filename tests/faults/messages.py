"""Messages to the viewer: whatever a browser sends, it is answered, and nothing fails."""

from __future__ import annotations

import json
import typing
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from msgspec import inspect

from mrgs.runs.open import load_run
from mrgs.viewer.browser import AnyMessage, Browser
from mrgs.viewer.server import start_at, start_camera
from mrgs.viewer.source import Worker
from tests.faults.fuzz import JSON, fuzz
from tests.faults.tally import Tally
from tests.helpers.subjects import subject_of

JOBS = 3
"""How many jobs of the viewer's worker are done after each message: a video goes on for long."""

LARGEST = 200
"""Pixels and indices beyond it are only tried now and then, because large pictures take long."""


def messages(folder: Path, run: Path, examples: int) -> Tally:
    """Messages of every kind with any values in range, some with one value replaced by another or
    cut off.

    Args:
        folder: where the viewer writes.
        run: a trained run, and its scene where it was trained from.
        examples: how many messages.
    """
    opened = load_run(run)
    scene = opened.load_scene()
    subject = replace(subject_of(opened, scene, folder), note="")
    worker, sent = _Queue(), list[str | bytes]()

    def send(data: str | bytes) -> Future[None]:
        sent.append(data)
        done: Future[None] = Future()
        done.set_result(None)
        return done

    start = start_at(start_camera(scene, opened.model), scene)
    browser = Browser(subject, start, "", worker, send)

    def receive(data: bytes) -> None:
        sent.clear()
        browser.receive(data)
        worker.work()
        for each in sent:
            _require_json(each)

    return fuzz(examples, _messages(), receive)


class _Queue(Worker):
    """Does the jobs of a viewer's worker when told to, in this thread."""

    def __init__(self) -> None:
        self._jobs = {}

    def put(self, key: Hashable, job: Callable[[], None]) -> None:
        self._jobs[key] = job

    def work(self) -> None:
        for _ in range(JOBS):
            if not self._jobs:
                return
            self._jobs.pop(next(iter(self._jobs)))()
        self._jobs.clear()


def _require_json(data: str | bytes) -> None:
    """A text, or the facts before a picture; JavaScript's JSON knows neither NaN nor infinity."""
    if isinstance(data, bytes):
        length = int.from_bytes(data[:4], "little")
        assert data[4 + length :].startswith(b"\xff\xd8"), "no JPEG"
        data = data[4 : 4 + length].decode()

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    json.loads(data, parse_constant=refuse)


def _messages() -> st.SearchStrategy[bytes]:
    kinds = [inspect.type_info(kind) for kind in typing.get_args(AnyMessage)]
    whole = st.sampled_from(kinds).flatmap(_values)
    changed = st.tuples(whole, JSON, st.integers(0, 20)).map(_with_another_value)
    valid, texts = (
        values.map(lambda value: json.dumps(value).encode()) for values in (whole, whole | changed)
    )
    cut = st.tuples(texts, st.integers(0, 200)).map(lambda pair: pair[0][: pair[1]])
    deep = st.integers(1, 60_000).map(lambda depth: b"[" * depth)
    return st.one_of(*[valid] * 5, texts, cut, deep, st.binary(max_size=200))


def _with_another_value(change: tuple[dict[str, Any], Any, int]) -> dict[str, Any]:
    message, value, place = change
    name = sorted(message)[place % len(message)]
    return {**message, name: value}


def _values(kind: inspect.Type) -> st.SearchStrategy[Any]:
    """Values that a message may hold."""
    match kind:
        case inspect.StructType():
            fields = {field.encode_name: _values(field.type) for field in kind.fields}
            return st.fixed_dictionaries({"type": st.just(kind.tag), **fields})
        case inspect.IntType():
            ends = (kind.ge or 0, kind.le or 10**9)
            usual = st.integers(ends[0], min(ends[1], LARGEST))
            return st.one_of(*[usual] * 9, st.sampled_from(ends))
        case inspect.FloatType():
            low = kind.ge if kind.gt is None else kind.gt
            usual = st.sampled_from([0.1, 0.5, 1.0, 2.0, 50.0]).filter(
                lambda number: (low or 0) <= number <= kind.le
            )
            return usual | st.floats(low, kind.le, exclude_min=kind.gt is not None)
        case inspect.TupleType():
            return st.tuples(*map(_values, kind.item_types))
        case inspect.VarTupleType() if kind.min_length == kind.max_length == 9:
            turned = st.permutations([[1, 0, 0], [0, 1, 0], [0, 0, 1]]).map(
                lambda rows: [number for row in rows for number in row]
            )
            usual = st.lists(_values(kind.item_type), min_size=9, max_size=9)
            return st.one_of(turned, turned, turned, usual)
        case inspect.VarTupleType() | inspect.ListType():
            most = 8 if kind.max_length is None else kind.max_length
            return st.lists(_values(kind.item_type), min_size=kind.min_length or 0, max_size=most)
        case inspect.UnionType():
            return st.one_of(*map(_values, kind.types))
        case inspect.LiteralType():
            return st.sampled_from(kind.values)
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.StrType():
            return st.sampled_from(["rgb", "thermal", "", "../x", "<b>", "\udcff"]) | st.text(
                max_size=9
            )
    raise TypeError(f"no values are known for {kind}")
