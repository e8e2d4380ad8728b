"""What would stop the package on Windows or macOS, as far as its source shows it.

``mypy --platform win32`` finds the functions of the standard library that Windows does not have.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = {
    file.relative_to(ROOT).as_posix(): file
    for room in ("torchrl_ocwm", "examples")
    for file in (ROOT / room).rglob("*.py")
}
POSIX = {"fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
#: Starts processes in the way of the system, which is fork on Linux.
STARTS = {"Manager", "Pool", "Process", "ProcessPoolExecutor", "Queue"}
#: Read where it is there, for the name of the processor.
ONLY_ON_LINUX = {"torchrl_ocwm/origin.py": {"/proc/cpuinfo"}}


def found(tree: ast.AST, file: str = "") -> list[str]:
    """What would not work elsewhere."""
    allowed = ONLY_ON_LINUX.get(file, set())
    kinds = {
        "imports": [name for name in imports(tree) if name.split(".")[0] in POSIX],
        "is a path of Linux": [text for text in texts(tree) - allowed if re.match("/(dev|proc|tmp|var)(/|$)", text)],
        "does not spawn": [ast.unparse(call) for call in calls(tree) if may_fork(call)],
        "has no encoding": [ast.unparse(call) for call in calls(tree) if has_no_encoding(call)],
        "has no pathlib": [name for name in map(called, calls(tree)) if name in ("os.path.join", "os.path.split")],
    }
    return [f"{kind}: {one}" for kind, every in kinds.items() for one in every]


def imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)


def texts(tree: ast.AST) -> set[str]:
    """All of them, without docstrings."""
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    constants = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in prose]
    return {node.value for node in constants if isinstance(node.value, str)}


def calls(tree: ast.AST) -> list[ast.Call]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def called(call: ast.Call) -> str:
    return ast.unparse(call.func)


def named(call: ast.Call) -> dict[str | None, str]:
    return {one.arg: ast.unparse(one.value) for one in call.keywords}


def may_fork(call: ast.Call) -> bool:
    """Whether a call starts processes otherwise than by spawn."""
    owner, _, name = called(call).rpartition(".")
    if name in ("get_context", "set_start_method"):
        return [ast.unparse(one) for one in call.args] != ["'spawn'"]
    if name == "ParallelEnv":
        return named(call).get("mp_start_method") != "'spawn'"
    return name in STARTS and owner.rpartition(".")[2] in ("", "futures", "mp", "multiprocessing")


def has_no_encoding(call: ast.Call) -> bool:
    """Whether a call reads or writes text in the encoding of the system."""
    _, _, name = called(call).rpartition(".")
    mode = [text for text in map(ast.unparse, call.args) if re.fullmatch("'[rwaxbt+]+'", text)]
    is_text = name == "open" and (not call.args or bool(mode)) and "b" not in "".join(mode)
    return (is_text or name in ("read_text", "write_text")) and "encoding" not in named(call)


@pytest.mark.parametrize("file", SOURCES)
def test_nothing_that_only_linux_has(file: str) -> None:
    assert found(ast.parse(SOURCES[file].read_text(encoding="utf-8")), file) == []


@pytest.mark.parametrize(
    "source",
    [
        "import fcntl",
        "from resource import getrusage",
        "shared = '/dev/shm'",
        "Path(f'/tmp/{name}')",
        "multiprocessing.get_context('fork')",
        "multiprocessing.Process(target=run)",
        "mp.Pool()",
        "ProcessPoolExecutor()",
        "ParallelEnv(2, make)",
        "file.read_text()",
        "file.write_text(text)",
        "file.open()",
        "file.open('w')",
        "open(file, 'r')",
        "os.path.join(a, b)",
    ],
)
def test_what_is_found(source: str) -> None:
    assert len(found(ast.parse(source))) == 1


@pytest.mark.parametrize(
    "source",
    [
        "'''Not /dev/shm.'''",
        "multiprocessing.get_context('spawn').Process(target=run)",
        "ParallelEnv(2, make, mp_start_method='spawn')",
        "file.read_text(encoding='utf-8')",
        "file.open('rb')",
        "EpisodeDataset.open(path)",
        "os.open(path, flags)",
    ],
)
def test_what_is_right(source: str) -> None:
    assert found(ast.parse(source)) == []


def test_files_of_the_repository_have_names_that_all_systems_can_have() -> None:
    """Also where upper and lower case are the same."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    if not listed:
        pytest.skip("no checkout")
    names = listed.split("\0")[:-1]
    reserved = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)
    parts = {part for name in names for part in name.split("/")}
    assert [part for part in parts if re.search(r'[<>:"\\|?*]|[. ]$', part) or reserved.match(part)] == []
    assert len({name.lower() for name in names}) == len(names)
