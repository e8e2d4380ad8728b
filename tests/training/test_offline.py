from __future__ import annotations

import errno
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState
from torchrl.record.loggers import CSVLogger

import torchrl_ocwm
from torchrl_ocwm.agents import SIZES, Agent, build_agent, save_agent
from torchrl_ocwm.agents.archive import Archive
from torchrl_ocwm.agents.checkpoint import describe, rebuild
from torchrl_ocwm.data import DatasetError, EpisodeDataset, RelabelGoals
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.evaluation import LandmarkEvaluation
from torchrl_ocwm.evaluation.videos import OpenLoopFilm
from torchrl_ocwm.files import FolderInUseError
from torchrl_ocwm.settings import SettingsError, change
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training import hooks, provenance
from torchrl_ocwm.training.loggers import LogError
from torchrl_ocwm.training.offline import EvaluationError, train_offline
from torchrl_ocwm.training.settings import Training

ZIP = "checkpoint.zip"
SHORT = Training(updates=12, log_interval=2, checkpoint_interval=4, eval_interval=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "random", reacher_task())


def fresh(name: str = "dreamer_pcp") -> Agent:
    torch.manual_seed(0)
    return build_agent(name, reacher_task(), "debug")


def train(agent: Agent, dataset: EpisodeDataset, folder: Path, training: Training = SHORT, **kwargs: Any) -> Path:
    return train_offline(agent, dataset, folder, training, progress=False, **kwargs)


def same(first: Agent, second: Agent) -> bool:
    pairs = zip(first.state_dict().items(), second.state_dict().items(), strict=True)
    return all(name == other and torch.equal(value, there) for (name, value), (other, there) in pairs)


def updates_in(file: Path) -> int:
    counts: dict[str, int] = {}

    class State:
        def state_dict(self) -> dict[str, int]:
            return {}

        def load_state_dict(self, state: dict[str, int]) -> None:
            counts.update(state)

    Archive(trainer_state=State()).load(file)
    return counts["collected_frames"]


def signal_at(updates: int, number: int) -> Callable[[int], dict[str, float]]:
    def evaluate(now: int) -> dict[str, float]:
        if now == updates:
            os.kill(os.getpid(), number)
        return {}

    return evaluate


class TestResume:
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_stopped_and_continued_is_as_never_stopped(
        self, dataset: EpisodeDataset, tmp_path: Path, number: int
    ) -> None:
        """Bit for bit: parameters, slow critic, return statistics."""
        through = fresh()
        train(through, dataset, tmp_path / "through")
        for stop in (4, 10):
            part = fresh()
            train(part, dataset, tmp_path / "parts", evaluate=signal_at(stop, number))
            assert not same(part, through)
        last = fresh()
        train(last, dataset, tmp_path / "parts")
        assert same(last, through)

    def test_training_changes_everything(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        before, after = fresh(), fresh()
        train(after, dataset, tmp_path)
        for old, new in zip(before.parameter_groups(), after.parameter_groups(), strict=True):
            assert not any(torch.equal(*pair) for pair in zip(old["params"], new["params"], strict=True))

    def test_a_finished_run_is_left_alone(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        file = train(fresh(), dataset, tmp_path)
        before = file.read_bytes()
        again = fresh()
        train(again, dataset, tmp_path)
        assert file.read_bytes() == before
        assert not same(again, fresh())  # it was loaded

    def test_looking_changes_nothing(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        watched, alone = fresh(), fresh()
        train(watched, dataset, tmp_path / "watched", evaluate=lambda updates: {"noise": float(torch.rand(1))})
        train(alone, dataset, tmp_path / "alone")
        assert same(watched, alone)

    def test_goals_change_the_run(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        first, second = fresh("dreamer"), fresh("dreamer")
        train(first, dataset, tmp_path / "first", replace(SHORT, updates=2, goals="uniform"))
        train(second, dataset, tmp_path / "second", replace(SHORT, updates=2, goals="stored"))
        assert not same(first, second)

    def test_threads(self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        threads: list[int] = []
        monkeypatch.setattr(torch, "set_num_threads", threads.append)
        for number in (0, 3):
            train(fresh(), dataset, tmp_path / str(number), replace(SHORT, updates=2, threads=number))
        assert threads == [3]

    def test_a_run_of_a_gpu_goes_on_without_one(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Here its first updates are made without one too, so that they are the same."""
        through, last = fresh(), fresh()
        train(through, dataset, tmp_path / "through")
        of_cpu = GlobalRNGState.state_dict
        with monkeypatch.context() as there:
            there.setattr(GlobalRNGState, "state_dict", lambda self: {**of_cpu(self), "torch_cuda": [torch.zeros(1)]})
            train(fresh(), dataset, tmp_path / "parts", evaluate=signal_at(4, signal.SIGTERM))
        train(last, dataset, tmp_path / "parts")
        assert same(last, through)

    def test_seed_changes_the_run(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        first, second = fresh(), fresh()
        train(first, dataset, tmp_path / "first")
        train(second, dataset, tmp_path / "second", replace(SHORT, seed=1))
        assert not same(first, second)


class TestGoingOn:
    """A run that goes on is held to the dataset and to the settings that decide what is learnt."""

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"goals": "stored"}, r"training\.goals: auto there, stored here\); say training\.changed=\[goals\]"),
            ({"final_lr": 0.5}, r"training\.final_lr: 0\.1 there, 0\.5 here"),
            ({"target_rate": 0.5}, r"training\.target_rate: 0\.02 there, 0\.5 here"),
            ({"mixed_precision": True}, r"training\.mixed_precision: False there, True here"),
            ({"seed": 1}, r"training\.seed: 0 there, 1 here\); choose another output folder"),
        ],
    )
    def test_a_finished_run_with_other_settings_is_refused(
        self, dataset: EpisodeDataset, tmp_path: Path, changes: dict[str, Any], message: str
    ) -> None:
        training = replace(SHORT, updates=2)
        file = train(fresh(), dataset, tmp_path, training)
        before, started = file.read_bytes(), []
        for updates in (2, 4):
            changed = replace(training, updates=updates, **changes)
            with pytest.raises(CheckpointError, match=message):
                train(fresh(), dataset, tmp_path, changed, on_start=lambda: started.append(1))
        assert file.read_bytes() == before
        assert not started

    def test_what_is_said_to_have_changed_is_changed(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        training = replace(SHORT, updates=2)
        file = train(fresh(), dataset, tmp_path, training)
        other = replace(training, updates=4, final_lr=0.5, changed=("final_lr",))
        train(fresh(), dataset, tmp_path, other)
        train(fresh(), dataset, tmp_path, replace(other, changed=()))  # the checkpoint has it now
        with pytest.raises(CheckpointError, match=r"final_lr: 0\.5 there, 0\.1 here"):
            train(fresh(), dataset, tmp_path, training)
        assert Checkpoint.manifest(file)["metadata"]["trained_with"]["training"]["final_lr"] == 0.5

    def test_a_setting_that_came_later_had_its_default(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        there = Checkpoint.manifest(file)["metadata"]["trained_with"]
        del there["training"]["target_rate"]
        monkeypatch.setattr(provenance, "_read", lambda file: there)
        provenance.check_may_go_on(file, SHORT, dataset)
        with pytest.raises(CheckpointError, match=r"target_rate: 0\.02 there, 0\.5 here"):
            provenance.check_may_go_on(file, replace(SHORT, target_rate=0.5), dataset)

    def test_a_checkpoint_tells_its_episodes(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = train(fresh(), dataset, tmp_path, replace(SHORT, updates=1))
        lengths = dataset.episode_lengths
        seen = repr(lengths).encode() + dataset.records["action"][: sum(lengths)].numpy().tobytes()
        assert provenance.trained_on(file) == sha256(seen).hexdigest()
        monkeypatch.setattr(provenance, "_read", lambda file: None)  # as of a release that did not keep them
        assert provenance.trained_on(file) == ""

    def test_what_changes_nothing_may_change(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        free = {"log_interval": 1, "checkpoint_interval": 1, "eval_interval": 0, "video_interval": 0, "threads": 1}
        assert updates_in(train(fresh(), dataset, tmp_path, replace(SHORT, updates=4, **free))) == 4

    def test_another_dataset(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        other = random_dataset(tmp_path / "other", reacher_task(), episodes=5)
        other_first = random_dataset(tmp_path / "first", reacher_task(), episodes=1)
        train(fresh(), other, tmp_path / "run", replace(SHORT, updates=2))
        with pytest.raises(CheckpointError, match=r"5 other episodes there than in .*first.*changed=\[dataset\]"):
            train(fresh(), other_first, tmp_path / "run", replace(SHORT, updates=2))
        moved = EpisodeDataset.open((tmp_path / "other").rename(tmp_path / "moved"))
        train(fresh(), moved, tmp_path / "run", replace(SHORT, updates=2))

    def test_another_dataset_of_the_same_shape(self, tmp_path: Path) -> None:
        other = random_dataset(tmp_path / "other", reacher_task())
        train(fresh(), other, tmp_path / "run", replace(SHORT, updates=2))
        actions = EpisodeDataset.open(tmp_path / "other").records["action"]
        (tmp_path / "other" / "frames" / "action.memmap").write_bytes((0.5 * actions).numpy().tobytes())
        with pytest.raises(CheckpointError, match="4 other episodes there"):
            train(fresh(), EpisodeDataset.open(tmp_path / "other"), tmp_path / "run", replace(SHORT, updates=2))

    def test_a_dataset_that_has_grown(self, tmp_path: Path) -> None:
        grown = random_dataset(tmp_path / "data", reacher_task())
        training = replace(SHORT, updates=2)
        file = train(fresh(), grown, tmp_path / "run", training)
        with EpisodeDataset.open(grown.path, write=True) as grown:
            records = random_records(reacher_task(), 1, 20, seed=7)[0]
            records["action"][0] = 0
            records["next", "done"][-1] = True
            grown.append(records)
        with pytest.raises(CheckpointError, match=r"has grown by 1 episodes\); say training\.changed=\[dataset\]"):
            train(fresh(), grown, tmp_path / "run", training)
        train(fresh(), grown, tmp_path / "run", replace(training, updates=4, changed=("dataset",)))
        assert Checkpoint.manifest(file)["metadata"]["trained_with"]["dataset"]["episodes"] == 5

    def test_fewer_updates_than_there_are_train_nothing_and_say_so(
        self, dataset: EpisodeDataset, tmp_path: Path
    ) -> None:
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=4))
        with pytest.warns(RuntimeWarning, match="has 4 updates, more than 2; nothing was trained"):
            train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))

    def test_an_agent_without_the_state_of_training(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        save_agent(fresh(), tmp_path / "checkpoint.zip")
        with (
            pytest.warns(RuntimeWarning, match="are not compared"),
            pytest.raises(CheckpointError, match=r"checkpoint\.zip: cannot be loaded .*missing.*trainer_state"),
        ):
            train(fresh(), dataset, tmp_path)

    def test_a_backup_of_an_earlier_release_is_gone_on_from(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        file = train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        file.rename(tmp_path / ".checkpoint.zip.backup-1")
        started: list[int] = []
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2), on_start=lambda: started.append(1))
        assert not started
        assert updates_in(file) == 2

    def test_starts_once(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        started: list[int] = []
        for updates in (2, 2, 4):
            training = replace(SHORT, updates=updates)
            train(fresh(), dataset, tmp_path, training, on_start=lambda: started.append(1))
            assert len(started) == (1 if updates == 2 else 2)

    def test_two_runs_in_one_folder(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        refused: list[str] = []

        def second(updates: int) -> dict[str, float]:
            with pytest.raises(FolderInUseError, match=f"process {os.getpid()} is writing here") as raised:
                train(fresh(), dataset, tmp_path)
            refused.append(str(raised.value))
            return {}

        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2), evaluate=second)
        assert len(refused) == 1


class TestLooking:
    """Evaluations and films cannot lose work."""

    def test_an_evaluation_that_fails_leaves_its_update(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        def fails(updates: int) -> dict[str, float]:
            if updates == 6:
                raise OSError("no display")
            return {}

        message = r"evaluation after 6 updates failed \(OSError: no display\); the checkpoint of this update is kept"
        with pytest.raises(EvaluationError, match=message):
            train(fresh(), dataset, tmp_path, evaluate=fails)
        resumed, through, seen = fresh(), fresh(), []
        train(resumed, dataset, tmp_path, evaluate=lambda updates: seen.append(updates) or {})
        assert seen == [8, 10, 12]
        train(through, dataset, tmp_path / "through")
        assert same(resumed, through)

    @pytest.mark.parametrize(("error", "kind"), [(TypeError("a bug"), RuntimeError), (LogError("x"), EvaluationError)])
    def test_only_what_a_user_can_mend_becomes_one_line(
        self, dataset: EpisodeDataset, tmp_path: Path, error: Exception, kind: type
    ) -> None:
        def fails(updates: int) -> dict[str, float]:
            raise error

        with pytest.raises(RuntimeError, match="the checkpoint of this update is kept") as raised:
            train(fresh(), dataset, tmp_path, evaluate=fails)
        assert type(raised.value) is kind
        assert raised.value.__cause__ is error
        assert updates_in(tmp_path / ZIP) == 2

    def test_the_checkpoint_that_is_due_comes_before_the_evaluation(
        self, dataset: EpisodeDataset, tmp_path: Path
    ) -> None:
        seen: dict[int, int] = {}

        def evaluate(updates: int) -> dict[str, float]:
            file = tmp_path / "checkpoint.zip"
            seen[updates] = updates_in(file) if file.exists() else 0
            return {}

        train(fresh(), dataset, tmp_path, evaluate=evaluate)
        assert seen == {2: 0, 4: 4, 6: 4, 8: 8, 10: 8, 12: 12}

    def test_the_last_update_is_saved_once_and_before_its_evaluation(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        saved, seen, save = [], [], Archive.save
        monkeypatch.setattr(Archive, "save", lambda self, path: (saved.append(1), save(self, path)))
        training = replace(SHORT, updates=2, checkpoint_interval=100)
        train(
            fresh(), dataset, tmp_path, training, evaluate=lambda updates: seen.append(updates_in(tmp_path / ZIP)) or {}
        )
        assert seen == [2]
        assert len(saved) == 1

    def test_a_film_that_fails_is_a_warning(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        def fails(updates: int) -> Path:
            raise RuntimeError("no ffmpeg")

        training = replace(SHORT, updates=4, video_interval=4)
        with pytest.warns(RuntimeWarning, match=r"no video after 4 updates \(RuntimeError: no ffmpeg\)"):
            file = train(fresh(), dataset, tmp_path, training, film=fails)
        assert updates_in(file) == 4

    def test_too_few_landmarks_are_named_before_training(self) -> None:
        with pytest.raises(SettingsError, match="eval_episodes=2, but reacher has 0 landmark goals"):
            LandmarkEvaluation(fresh(), episodes=2, episode_steps=3)

    def test_no_ffmpeg_is_named_before_training(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
        with pytest.raises(MissingPackageError, match=r"torchrl-ocwm\[recipes\]'.*video_interval=0"):
            OpenLoopFilm(fresh(), dataset, tmp_path)

    def test_no_tqdm_is_named_before_training(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(hooks, "find_spec", lambda name: None)
        with pytest.raises(MissingPackageError, match=r"needs tqdm: pip install 'torchrl-ocwm\[recipes\]'"):
            train_offline(fresh(), dataset, tmp_path / "run", SHORT)
        assert not (tmp_path / "run").exists()
        train(fresh(), dataset, tmp_path / "run", replace(SHORT, updates=2))

    def test_no_such_device(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        for device in ("cuda:99", "gpu"):
            with pytest.raises(ValueError, match=f"device '{device}' cannot be used .*; device 'cpu' always can"):
                train(fresh(), dataset, tmp_path / "run", replace(SHORT, device=device))
        assert not (tmp_path / "run").exists()


class TestSignals:
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_a_signal_between_two_lines_of_the_log(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
    ) -> None:
        """Ends the run after the update at hand, and the run goes on there bit for bit."""
        training = replace(SHORT, log_interval=6, checkpoint_interval=100, eval_interval=5)
        relabel, batches = RelabelGoals.forward, []

        def at_third(self: Any, batch: Any) -> Any:
            batches.append(1)
            if len(batches) == 3:
                os.kill(os.getpid(), number)
            return relabel(self, batch)

        with monkeypatch.context() as patch:
            patch.setattr(RelabelGoals, "forward", at_third)
            file = train(fresh(), dataset, tmp_path, training)
        assert updates_in(file) == 3
        resumed, through, seen = fresh(), fresh(), []
        train(resumed, dataset, tmp_path, training, evaluate=lambda updates: seen.append(updates) or {})
        assert seen == [5, 10]
        train(through, dataset, tmp_path / "through", training)
        assert same(resumed, through)

    def test_a_signal_breaks_off_an_evaluation(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        def endless(updates: int) -> dict[str, float]:
            os.kill(os.getpid(), signal.SIGTERM)
            while True:
                time.sleep(0.01)

        file = train(fresh(), dataset, tmp_path, evaluate=endless)
        assert updates_in(file) == 2

    def test_a_signal_that_comes_back_as_another_error(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        """As ctypes does while an image is drawn."""

        def draw(updates: int) -> dict[str, float]:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5)
            except BaseException as error:
                raise OSError("argument 2") from error
            return {}

        file = train(fresh(), dataset, tmp_path, evaluate=draw)
        assert updates_in(file) == 2

    def test_handlers_are_given_back(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


class TestLogs:
    def test_csv(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        train(fresh(), dataset, tmp_path, evaluate=lambda updates: {"evaluation/score": float(updates)})
        scalars = tmp_path / "log" / "scalars"
        assert (scalars / "evaluation" / "score.csv").read_text().split() == [
            f"{n},{float(n)}" for n in (2, 4, 6, 8, 10, 12)
        ]
        assert len((scalars / "loss_actor.csv").read_text().split()) == 6

    def test_losses_are_averaged_between_two_lines(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        lines = {}
        for interval in (1, 4):
            train(fresh(), dataset, tmp_path / str(interval), replace(SHORT, updates=6, log_interval=interval))
            rows = (tmp_path / str(interval) / "log" / "scalars" / "loss_value.csv").read_text().split()
            lines[interval] = [tuple(map(float, row.split(","))) for row in rows]
        values = [value for _, value in lines[1]]
        expected = [(4, sum(values[:4]) / 4), (6, sum(values[4:]) / 2)]  # the last update has a line too
        assert [step for step, _ in lines[4]] == [step for step, _ in expected]
        assert [value for _, value in lines[4]] == pytest.approx([value for _, value in expected], rel=1e-5)

    def test_a_run_that_goes_on_repeats_no_line(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        """Killed after the line of update 10 had been written, with a checkpoint of update 8."""

        class Killed(BaseException):
            pass

        def kill(updates: int) -> dict[str, float]:
            if updates == 10:
                raise Killed
            return {"evaluation/score": float(updates)}

        training = replace(SHORT, checkpoint_interval=4, updates=12)
        with pytest.raises(Killed):
            train(fresh(), dataset, tmp_path, replace(training, checkpoint_interval=8), evaluate=kill)
        scalars = tmp_path / "log" / "scalars"
        with (scalars / "loss_actor.csv").open("a") as file:
            file.write("12,0.")  # cut off
        train(fresh(), dataset, tmp_path, training, evaluate=lambda updates: {"evaluation/score": float(updates)})
        for name in ("loss_actor.csv", "evaluation/score.csv"):
            rows = (scalars / name).read_text().splitlines()
            assert [row.split(",")[0] for row in rows] == ["2", "4", "6", "8", "10", "12"], name

    def test_a_run_that_starts_anew_forgets_the_lines_of_one_without_a_checkpoint(
        self, dataset: EpisodeDataset, tmp_path: Path
    ) -> None:
        file = train(fresh(), dataset, tmp_path, replace(SHORT, updates=4))
        file.unlink()
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        assert len((tmp_path / "log" / "scalars" / "loss_actor.csv").read_text().split()) == 1

    def test_a_log_that_cannot_be_written(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(*args: Any, **kwargs: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        file = train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        before = file.read_bytes()
        monkeypatch.setattr(CSVLogger, "log_scalar", full)
        with pytest.raises(LogError, match="cannot write the log .No space left on device.; the last checkpoint"):
            train(fresh(), dataset, tmp_path, replace(SHORT, updates=4))
        assert file.read_bytes() == before


class TestLoadAgent:
    def test_acts_like_the_trained_agent(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        agent = fresh()
        policy = torchrl_ocwm.load_agent(train(agent, dataset, tmp_path))
        step = dataset.records["next"][:3].exclude("reward", "done", "terminated").clone()
        step["is_init"] = torch.ones(3, 1, dtype=torch.bool)
        actions = []
        for one in (policy, agent.policy()):
            torch.manual_seed(1)
            actions.append(one(step.clone())["action"])
        torch.testing.assert_close(*actions, rtol=0, atol=0)
        assert not any(parameter.requires_grad for parameter in policy.parameters())

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no such checkpoint"):
            torchrl_ocwm.load_agent(tmp_path / "none.zip")

    def test_not_a_checkpoint(self, tmp_path: Path) -> None:
        (tmp_path / "x.zip").write_text("hello")
        with pytest.raises(CheckpointError, match=r"x\.zip: not a checkpoint of TorchRL"):
            torchrl_ocwm.load_agent(tmp_path / "x.zip")

    def test_foreign(self, tmp_path: Path) -> None:
        Checkpoint(format="archive", loss_module=torch.nn.Linear(1, 1)).save(tmp_path / "x.zip")
        with pytest.raises(CheckpointError, match="not of an agent of torchrl_ocwm"):
            torchrl_ocwm.load_agent(tmp_path / "x.zip")


class TestOtherReleases:
    """Descriptions in checkpoints, with settings that this release does not have or that are not there yet."""

    def description(self) -> dict[str, Any]:
        return json.loads(json.dumps(describe(fresh("focus_lcp"))))

    def test_settings_that_came_later_take_their_defaults(self) -> None:
        description = self.description()
        del description["agent"]["behaviours"]["reach"]["goal"]["weight"], description["size"]["learning"]["gamma"]
        agent = rebuild(description)
        assert (agent.config.behaviours["reach"].goal.weight, agent.size.learning.gamma) == (1.0, 0.99)

    def test_settings_that_are_gone(self) -> None:
        description = self.description()
        description["agent"]["colour"] = "red"
        del description["size"]["learning"]["batch_size"]
        with pytest.raises(CheckpointError, match=r"agent\.colour is no setting"):
            rebuild(description)
        del description["agent"]["colour"]
        with pytest.raises(CheckpointError, match=r"size\.learning\.batch_size is missing"):
            rebuild(description)


class TestBadInput:
    def test_checkpoint_of_another_agent(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        file = train(fresh("dreamer"), dataset, tmp_path)
        before = file.read_bytes()
        with pytest.raises(CheckpointError, match=r"reach\.goal\.name: none there, position here"):
            train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before

    def test_checkpoint_of_another_size(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        """Also of one that has the same shapes, and learns in another way."""
        train(fresh(), dataset, tmp_path, replace(SHORT, updates=2))
        size = change(SIZES["debug"], {"learning.gamma": 0.5})
        with pytest.raises(CheckpointError, match=r"size\.learning\.gamma: 0\.99 there, 0\.5 here"):
            train(build_agent("dreamer_pcp", reacher_task(), size), dataset, tmp_path)

    def test_images_that_show_the_goal_contradict_imagined_ones(self, tmp_path: Path) -> None:
        task = replace(reacher_task(), options={"virtual_target": 5})
        shown = random_dataset(tmp_path / "data", task)
        torch.manual_seed(0)
        with pytest.raises(DatasetError, match=r"the images show the goal .* the behaviour 'reach' is given others"):
            train(build_agent("dreamer_pcp", task, "debug"), shown, tmp_path / "pcp")
        assert train(build_agent("dreamer", task, "debug"), shown, tmp_path / "dreamer").exists()

    def test_dataset_of_another_task(self, tmp_path: Path) -> None:
        other = random_dataset(tmp_path / "data", reacher_task(32))
        with pytest.raises(
            DatasetError, match=r"of another task than the agent \(image_size: 32 in the dataset, 64 in"
        ):
            train(fresh(), other, tmp_path / "run")

    def test_sequences_longer_than_episodes(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        agent = build_agent("dreamer_pcp", reacher_task(), change(SIZES["debug"], {"learning.slice_len": 21}))
        with pytest.raises(DatasetError, match="cannot cut sequences of 21 frames, the longest episode has 20"):
            train(agent, dataset, tmp_path)

    def test_folder_that_cannot_be_written(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(CheckpointError, match="cannot write here .* choose another output folder"):
            train(fresh(), dataset, tmp_path / "file" / "run")

    def test_full_disk_keeps_the_checkpoint_before(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()

        def full(*args: Any, **kwargs: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoint, "save", full)
            with pytest.raises(CheckpointError, match="No space left on device.*before it is kept"):
                train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before
        resumed, through = fresh(), fresh()
        train(resumed, dataset, tmp_path)
        train(through, dataset, tmp_path / "through")
        assert same(resumed, through)

    def test_a_write_that_breaks_off_leaves_the_checkpoint_before(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The new checkpoint takes the old one's place in one step, when it is whole."""
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()

        def broken(*args: Any, **kwargs: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", broken)
            with pytest.raises(CheckpointError, match="before it is kept"):
                train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before

    @pytest.mark.parametrize("log_interval", [2, 12], ids=["at a line of the log", "at a checkpoint"])
    def test_losses_that_are_not_finite(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log_interval: int
    ) -> None:
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()
        relabel = RelabelGoals.forward

        def spoiled(self: Any, batch: Any) -> Any:
            batch = relabel(self, batch)
            batch["next", "proprio"] = torch.full_like(batch["next", "proprio"], torch.nan)
            return batch

        monkeypatch.setattr(RelabelGoals, "forward", spoiled)
        training = replace(SHORT, log_interval=log_interval, checkpoint_interval=6)
        with pytest.raises(FloatingPointError, match=r"after 6 updates .*loss_model_proprio.* is not finite"):
            train(fresh(), dataset, tmp_path, training)
        assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"updates": 0}, "updates must be at least 1"),
        (
            {"changed": ("seed",)},
            "changed must name dataset, goals, .*final_lr, target_rate, got 'seed'",
        ),
        ({"goals": "mine"}, "goals must be one of 'auto', 'uniform', 'stored', got 'mine'"),
        ({"loggers": ("paper",)}, "loggers must be one of 'tensorboard', 'wandb', got 'paper'"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Training(**changes)
