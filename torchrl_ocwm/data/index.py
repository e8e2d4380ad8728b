"""The index of a dataset: what it may say. It is checked whole before anything is mapped or built from it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_ocwm.data.contract import DatasetError, check_keys
from torchrl_ocwm.envs.task import Task

INDEX = "dataset.json"
FORMAT, VERSION = "torchrl_ocwm dataset", 1
#: The types that frames may have, by the names that the index gives them.
DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
        *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    )
}

Check = Callable[[str, Any], None]


def describe(record: TensorDictBase) -> dict[str, Any]:
    """Shape and dtype of each key of a record (batch size ``[]``), as the index has them."""
    return {
        name: [[*value.shape], str(value.dtype).removeprefix("torch.")]
        for name, value in sorted(record.flatten_keys("/").items())
    }


def read_index(folder: Path) -> dict[str, Any]:
    """Read the index in a folder.

    Raises:
        DatasetError: if there is none, or it is not wholly as it should be.
    """
    file = folder / INDEX
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file; {folder} holds no dataset of torchrl_ocwm") from None
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: not JSON ({error}); the dataset is corrupt") from error
    try:
        index = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: not JSON ({error}); the dataset is corrupt") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise DatasetError(f"{file}: not an index of a torchrl_ocwm dataset")
    if type(index.get("version")) is not int or index["version"] != VERSION:
        raise DatasetError(f"{file}: version {index.get('version')}, this release reads version {VERSION}")
    try:
        check_index(index)
    except DatasetError as error:
        raise DatasetError(f"{file}: {error}; the dataset is corrupt") from None
    return index


def to_json(index: dict[str, Any]) -> str:
    """An index as the text of its file.

    Raises:
        DatasetError: if something in it does not fit in JSON.
    """
    try:
        return json.dumps(index, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{INDEX}: the metadata of a dataset must fit in JSON ({error})") from error


def check_fields(index: dict[str, Any]) -> None:
    """Check the types and ranges of an index, not yet whether they fit together.

    Raises:
        DatasetError: naming the first entry that is not as it should be.
    """
    _INDEX("", index)


def check_index(index: dict[str, Any]) -> None:
    """Check an index as it is read from JSON.

    Raises:
        DatasetError: naming the first entry that is not as it should be.
    """
    check_fields(index)
    if sum(index["episode_lengths"]) != index["records"]:
        raise DatasetError(
            f"episode lengths do not add up to the number of records, {sum(index['episode_lengths'])} are not "
            f"{index['records']}"
        )
    if len(index.get("checksums", index["episode_lengths"])) != len(index["episode_lengths"]):
        raise DatasetError(
            f"{len(index['checksums'])} checksums are not those of {len(index['episode_lengths'])} episodes"
        )
    _check_names(index["keys"])
    _check_source(index)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number")


# What may be there.


def _join(name: str, field: str) -> str:
    return f"{name}.{field}" if name else field


def _is(expected: str, holds: Callable[[Any], bool]) -> Check:
    """A rule for one value; the error names its place, what was expected and what is there."""

    def check(name: str, value: Any) -> None:
        if not holds(value):
            shown = repr(value)
            shown = shown if len(shown) < 60 else f"{shown[:60]}..."
            raise DatasetError(f"{name}: expected {expected}, got {shown}")

    return check


def _count(least: int) -> Check:
    return _is(f"a whole number of at least {least}", lambda value: type(value) is int and value >= least)


def _list(item: Check, *, least: int = 0, exactly: int | None = None) -> Check:
    expected = f"a list of {exactly}" if exactly is not None else f"a list of at least {least}" if least else "a list"

    def is_as_long(value: Any) -> bool:
        return isinstance(value, list) and len(value) >= least and exactly in (None, len(value))

    is_list = _is(expected, is_as_long)

    def check(name: str, value: Any) -> None:
        is_list(name, value)
        for number, one in enumerate(value):
            item(f"{name}[{number}]", one)

    return check


def _mapping(item: Check) -> Check:
    def check(name: str, value: Any) -> None:
        _is("a mapping", lambda value: isinstance(value, dict))(name, value)
        for key, one in value.items():
            item(_join(name, key), one)

    return check


def _fields(required: Mapping[str, Check], optional: Mapping[str, Check], *, others: bool = False) -> Check:
    """A mapping with these fields; with other ones only if so said."""

    def check(name: str, value: Any) -> None:
        _is("a mapping", lambda value: isinstance(value, dict))(name, value)
        lacking, unknown = set(required) - set(value), set(value) - set(required) - set(optional)
        if lacking:
            raise DatasetError(f"{name}: lacks {sorted(lacking)}".removeprefix(": "))
        if unknown and not others:
            raise DatasetError(f"{name}: knows no {sorted(unknown)}")
        for field, rule in {**required, **optional}.items():
            if field in value:
                rule(_join(name, field), value[field])

    return check


def _or_null(rule: Check) -> Check:
    return lambda name, value: None if value is None else rule(name, value)


def _plain(name: str, value: Any) -> None:
    """Settings of an environment: they go into configurations, where ``${...}`` would be replaced."""
    if isinstance(value, dict):
        _list(_text)(name, [*value])
        _mapping(_plain)(name, value)
    elif isinstance(value, list):
        _list(_plain)(name, value)
    elif isinstance(value, str):
        _is("a text without '${'", lambda value: "${" not in value)(name, value)
    elif value is not None and not isinstance(value, bool):
        _number(name, value)


_text = _is("a name", lambda value: isinstance(value, str) and bool(value.strip()) and "${" not in value)
_number = _is("a number", lambda value: type(value) in (int, float) and abs(value) <= 1e6)
_share = _is("a share of 1", lambda value: type(value) in (int, float) and 0 <= value <= 1)
_flag = _is("true or false", lambda value: isinstance(value, bool))
_dtype = _is(f"one of {', '.join(DTYPES)}", lambda value: isinstance(value, str) and value in DTYPES)


def _image_size(name: str, value: Any) -> None:
    (_list(_count(1), exactly=2) if isinstance(value, list) else _count(1))(name, value)


def _options(name: str, value: Any) -> None:
    _is("a mapping", lambda value: isinstance(value, dict))(name, value)
    _plain(name, value)


def _key(name: str, value: Any) -> None:
    _is("[shape, dtype]", lambda value: isinstance(value, list) and len(value) == 2)(name, value)
    _list(_count(1))(f"{name} shape", value[0])
    _dtype(f"{name} dtype", value[1])


WORKSPACE = {"low": _list(_number, least=1), "high": _list(_number, least=1)}
WORKSPACE_OPTIONAL = {"reach": _or_null(_list(_number, exactly=2)), "landmarks": _list(_list(_number, least=1))}
TASK = {
    "name": _text,
    "image_size": _image_size,
    "objects": _list(_text, least=1),
    "proprio": _count(1),
    "action": _count(1),
    "workspace": _fields(WORKSPACE, WORKSPACE_OPTIONAL),
}
TASK_OPTIONAL = {
    "options": _options,
    "action_range": _or_null(_fields({"low": _list(_number, least=1), "high": _list(_number, least=1)}, {})),
    "discrete": _flag,
}
_INDEX = _fields(
    {
        "format": _text,
        "version": _count(1),
        "records": _count(0),
        "episode_lengths": _list(_count(1)),
        "keys": _mapping(_key),
    },
    {
        "checksums": _list(_count(0)),
        "environment": _text,
        "options": _options,
        "task": _fields(TASK, TASK_OPTIONAL),
        "policies": _mapping(_count(0)),
        "failures": _count(0),
        "coverage": _or_null(_mapping(_fields({"moves": _share, "visited": _share}, {}))),
    },
    others=True,
)


# How it must fit together.


def _check_names(keys: dict[str, Any]) -> None:
    for name in keys:
        if not re.fullmatch(r"[\w-]+(/[\w-]+)*", name):
            raise DatasetError(f"{name!r} of keys: expected names of letters, digits, '_' and '-', joined by '/'")
    for first, second in pairwise(sorted(keys, key=lambda name: name.split("/"))):
        if second.startswith(f"{first}/"):
            raise DatasetError(f"keys: {first!r} is a tensor and {second!r} is inside it")
    shape, dtype = keys.get("is_init", ([0], None))
    if prod(shape) != 1 or dtype != "bool":
        raise DatasetError(f"keys.is_init: expected one bool, which marks the first record of an episode, got {shape}")


def _check_source(index: dict[str, Any]) -> None:
    """A task comes with its environment and its options, and frames are as it says (docs/data.md)."""
    if not {"task", "options"} & set(index):
        return
    lacking = {"environment", "options", "task"} - set(index)
    if lacking:
        raise DatasetError(f"lacks {sorted(lacking)}")
    try:
        task = Task.from_dict(index["task"])
    except ValueError as error:
        raise DatasetError(str(error)) from error
    if index["environment"] != task.name:
        raise DatasetError(f"the environment {index['environment']!r} is not that of the task, {task.name!r}")
    options = {name: value for name, value in index["options"].items() if name != "horizon"}
    if options != task.options or options.get("image_size", task.image_size) != task.image_size:
        raise DatasetError(f"the options {index['options']} are not those of the task, {task.options}")
    check_keys(index["keys"], task)
