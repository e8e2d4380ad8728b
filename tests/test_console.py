"""The command ``ocwm``."""

from __future__ import annotations

import ast
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_ocwm import console

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.fixture
def ocwm(tmp_path: Path) -> Path:
    """The program that pip makes of the entry point."""
    program = tmp_path / "bin" / "ocwm"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nfrom torchrl_ocwm.console import main\nmain()\n")
    program.chmod(0o755)
    return program


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[list[str]]]:
    """Call it in this process; the recipes that are run, each with the words that follow it."""
    seen: list[list[str]] = []
    monkeypatch.setattr(console, "run", lambda command: seen.append([command, *sys.argv[1:]]))

    def call(*arguments: str) -> list[list[str]]:
        monkeypatch.setattr(sys, "argv", ["/there/ocwm", *arguments])
        console.main()
        return seen

    return call


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", [[], ["-h"], ["--help"]])
def test_help_has_each_command_on_a_line(
    called: Callable[..., list[list[str]]], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    assert called(*arguments) == []
    lines = capsys.readouterr().out.splitlines()
    for command, (_, what) in console.COMMANDS.items():
        assert [line.split(None, 1) for line in lines if line.startswith(f"  {command} ")] == [[command, what]]


def test_help_loads_neither_torch_nor_hydra() -> None:
    done = python(
        "import sys; from torchrl_ocwm.console import main; main(); print({'torch', 'hydra'} & {*sys.modules})"
    )
    assert done.stdout.endswith("set()\n"), done.stderr


def test_the_words_after_a_command_are_its_recipes(called: Callable[..., list[list[str]]]) -> None:
    assert called("train", "agent=focus", "--help") == [["train", "agent=focus", "--help"]]


@pytest.mark.parametrize(
    ("typed", "seen"),
    [
        (("play", "reacher/focus_lcp", "port=1"), ["agent='reacher/focus_lcp'", "port=1"]),
        (("play", "hf://it's/one"), ["agent='hf://it\\'s/one'"]),
        (("play", "agent=a"), ["agent=a"]),
        (("play", "--help"), ["--help"]),
        (("play",), []),
        (("evaluate", "reacher/focus_lcp", "goals=9"), ["checkpoint='reacher/focus_lcp'", "goals=9"]),
        (("diagnose", "reacher/focus_lcp", "dataset=d"), ["checkpoint='reacher/focus_lcp'", "dataset=d"]),
        (("import", "demos.hdf5"), ["source='demos.hdf5'"]),
        (("share", "outputs/evaluation"), ["evaluation='outputs/evaluation'"]),
        (("collect", "reacher"), ["reacher"]),
    ],
)
def test_a_first_word_that_is_no_setting(
    typed: tuple[str, ...], seen: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments: list[str] = []
    recipe = SimpleNamespace(main=lambda: arguments.extend(sys.argv[1:]))
    monkeypatch.setattr(console, "import_module", lambda name: recipe)
    monkeypatch.setattr(sys, "argv", ["ocwm", *typed])
    console.main()
    assert arguments == seen


def test_completion_is_installed_without_torch() -> None:
    """A shell that starts does not wait for it."""
    code = "import sys; from torchrl_ocwm.console import main; main(); print('torch' in sys.modules)"
    done = python(code, "-sc", "install=bash")
    assert "hydra_bash_completion()" in done.stdout, done.stderr
    assert done.stdout.endswith("False\n")
    code = "import sys; sys.modules['hydra'] = None; from torchrl_ocwm.console import main; main()"
    done = python(code, "-sc", "install=bash")
    assert done.stderr.startswith("ocwm: completion needs hydra, which is not installed: pip install 'torchrl-ocwm[")


def test_an_unknown_command(called: Callable[..., list[list[str]]]) -> None:
    with pytest.raises(SystemExit, match=r"^ocwm: there is no 'trian'; there are collect, train, .*\(ocwm --help\)$"):
        called("trian")


@pytest.mark.parametrize("command", console.COMMANDS)
def test_each_command_has_its_recipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["ocwm", "--cfg", "job"])
    console.run(command)
    of_its_own = {"collect": "dataset: data/", "import": "source: ", "play": "port: "}
    of_its_own |= dict.fromkeys(("export", "draw-targets"), "destination: ")
    assert of_its_own.get(command, "output: outputs/") in capsys.readouterr().out


def test_without_hydra_one_line_names_the_extra() -> None:
    code = "import sys; sys.modules['hydra'] = None; from torchrl_ocwm.console import main; main()"
    done = python(code, "train")
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert line == (
        "MissingPackageError: a recipe needs hydra, which is not installed: pip install 'torchrl-ocwm[recipes]'"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_while_packages_are_loaded_it_says_so_in_a_line(number: signal.Signals) -> None:
    code = (
        "import os, sys; from torchrl_ocwm import console\n"
        f"console.import_module = lambda name: os.kill(os.getpid(), {int(number)})\n"
        "console.main()"
    )
    done = python(code, "train")
    assert done.returncode == 128 + number
    assert done.stderr.split("\n") == ["", f"stopped by {number.name}; what has been written is whole", ""]


def test_a_fault_of_ours_shows_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(console.COMMANDS, "faulty", ("no_such_module", "Fail."))
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        console.run("faulty")


def test_exit_codes_and_help_in_another_folder(ocwm: Path, tmp_path: Path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([ocwm, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)

    wrong = run("collect", "steps=0")
    assert (wrong.returncode, wrong.stderr) == (1, "SettingsError: steps must be at least 1, got 0\n")
    shown = run("train", "--help")
    assert shown.returncode == 0
    assert "\ntraining.updates=10000: Updates of model, actor and critic in all. [whole number, 1 to" in shown.stdout


def test_help_of_which_nobody_reads_more(ocwm: Path) -> None:
    """As with ``| head``."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([ocwm, "train", "--help"], stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_pipe_that_breaks_otherwise_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise BrokenPipeError

    monkeypatch.setattr("torchrl_ocwm.recipes.collect.main", fail)
    monkeypatch.setattr(sys, "argv", ["ocwm", "steps=1"])
    with pytest.raises(BrokenPipeError):
        console.run("collect")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_is_a_command_and_nothing_else(example: Path) -> None:
    calls = [node for node in ast.walk(ast.parse(example.read_text())) if isinstance(node, ast.Call)]
    [[name]] = [[one.value for one in call.args if isinstance(one, ast.Constant)] for call in calls]
    assert console.COMMANDS[str(name)][0] == example.stem


class TestCompletion:
    """With Tab, as a shell asks for it."""

    @pytest.fixture
    def complete(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> Callable[[str], set[str]]:
        def ask(line: str) -> set[str]:
            monkeypatch.setenv("COMP_LINE", line)
            monkeypatch.setattr(sys, "argv", ["ocwm", "-sc", "query=bash"])
            console.main()
            return set(capsys.readouterr().out.split())

        return ask

    @pytest.mark.parametrize("line", ["ocwm ", "ocwm tra", "/opt/bin/ocwm "])
    def test_of_commands(self, complete: Callable[[str], set[str]], line: str) -> None:
        assert set(console.COMMANDS) <= complete(line)

    def test_of_settings(self, complete: Callable[[str], set[str]]) -> None:
        assert complete("ocwm train agent=focus_l") == {"agent=focus_lcp"}
        assert complete("ocwm train size=cpu training.upd") == {"training.updates="}
        assert complete("/opt/python/bin/ocwm collect ste") == {"steps="}

    def test_of_nothing(self, complete: Callable[[str], set[str]]) -> None:
        assert complete("ocwm nothing agent=") == set()

    @pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
    def test_in_bash(self, ocwm: Path) -> None:
        asked = """
            eval "$(ocwm -sc install=bash)"
            complete -p ocwm
            COMP_LINE="ocwm train agent=dreamer_" COMP_POINT=25 COMP_CWORD=2
            hydra_bash_completion
            echo "${COMPREPLY[@]}"
        """
        environment = {**os.environ, "PATH": f"{ocwm.parent}{os.pathsep}{os.environ['PATH']}"}
        done = subprocess.run(["bash", "-c", asked], env=environment, capture_output=True, text=True, check=True)
        installed, completed = done.stdout.splitlines()
        assert installed.endswith("-F hydra_bash_completion ocwm")
        assert completed == "agent=dreamer_pcp"
