# `make demo` shows what this is; `make test` checks it. Both set up everything they need, once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEMO := outputs/demo
# Updates of the demonstration. With 50,000 steps of data, all of it takes ten minutes on two quiet cores.
UPDATES ?= 1500
STEPS ?= 50000
WORKERS := 2
# The series of TorchRL after that of constraints.txt, as far as the package registry has it: the quick tests run with it.
NEXT := .venv-next
LONG := \
	tests/training/test_stepper.py::test_update_compiles_into_one_graph[dreamer-changes0] \
	tests/training/test_stepper.py::test_update_compiles_into_one_graph[dreamer_pcp-changes1] \
	tests/envs/test_scripted.py::test_script_reaches_the_landmarks[cube_move-60] \
	tests/envs/test_contract.py::test_gymnasium_checker[cube_lift] \
	tests/envs/test_contract.py::test_starts_through_torchrl_depend_on_their_seeds_alone[cube_lift] \
	tests/envs/test_contract.py::test_torchrl_specs_and_horizon[cube_lift] \
	tests/examples/test_every_environment.py::test_from_dataset_to_film[cube_lift-focus_lcp] \
	tests/examples/test_every_environment.py::test_from_dataset_to_film[pick_place-focus_lcp] \
	tests/examples/test_every_environment.py::test_from_dataset_to_film[reacher-dreamer] \
	tests/examples/test_every_environment.py::test_from_dataset_to_film[reacher-dreamer_pcp] \
	tests/examples/test_every_environment.py::test_from_dataset_to_film[reacher-focus] \
	tests/examples/test_stopping.py::test_ends_with_its_children[collect.py-9-False] \
	tests/evaluation/test_episodes.py::test_process_that_dies_or_hangs_ends_the_evaluation[19] \
	tests/data/test_collect.py::test_process_that_dies_or_hangs_is_replaced[19] \
	tests/training/test_online.py::test_the_recipe_goes_on_after_a_signal[Ctrl-C] \
	tests/examples/test_benchmarks.py::test_speed_of_an_evaluation_adds_up \
	tests/evidence/test_queue.py::test_several_at_a_time[ray]
# Other Pythons, of which the machine may have some (`python3.10`, or in pyenv): the package and its recipes, no simulator.
PYTHONS := 3.10 3.13
# GB that must be free for one of them: it comes with CUDA, 5 GB. It goes when its tests have passed.
PYTHON_SPACE := 10
NEXT_VERSIONS := torchrl-nightly==2026.10.27 tensordict==0.15.3

export MUJOCO_GL ?= egl
# Threads that wait for each other spin by default, for so long that beside another process they hardly get on.
export GOMP_SPINCOUNT ?= 10000

.PHONY: demo test lint test-next test-pythons test-long docs check clean FORCE
.DELETE_ON_ERROR:

demo: check $(DEMO)/evaluation/.done
	@echo
	@cat $(DEMO)/evaluation/results.md
	@echo
	@echo "Where to look, all in $(DEMO):"
	@echo "  evaluation/report.html                all that follows on one page for the browser"
	@echo "  evaluation/results.md, results.json   table and numbers, goal by goal"
	@echo "  evaluation/heatmap.png                score over the workspace: random actions, position goals, image goals"
	@echo "  evaluation/learning_curve.png         scores and losses while it learnt"
	@echo "  evaluation/episodes.mp4               above: what happened; below: what the agent imagined from frame one"
	@echo "  evaluation/episodes_image_goals.mp4   the same with goals given as images, which are shown on top"
	@echo "  focus_lcp/videos/                     open-loop predictions: truth, model, error"

test: check
	$(MAKE) --jobs 2 --output-sync lint test-next test-pythons
	$(BIN)/python -m pytest -q -n 2 --dist loadfile $(LONG:%=--deselect '%')

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What `make test` leaves out so that it stays below 20 minutes: others like them are in it.
test-long: check
	$(BIN)/mypy --platform win32
	$(BIN)/python -m pytest -q $(LONG:%='%')

test-next: $(NEXT)/.installed
	$(NEXT)/bin/python -m pytest -q -m "not slow" tests/modules tests/objectives \
		torchrl_ocwm/modules torchrl_ocwm/objectives

# One after the other: both write the package's metadata.
test-pythons:
	@$(MAKE) --jobs 1 $(PYTHONS:%=test-python-%)

test-python-%:
	@free=$$(df -Pk . | awk 'NR == 2 {print int($$4 / 1048576)}'); [ "$$free" -ge $(PYTHON_SPACE) ] || { \
		echo "Python $*: $$free GB are free here, its packages need $(PYTHON_SPACE): not tested with it"; exit 0; }; \
	for python in python$* $$HOME/.pyenv/versions/$*.*/bin/python; do \
		$$python -c '' 2> /dev/null && exec $(MAKE) FOUND=$$python .venv-$*/.tested; \
	done; echo "Python $* is not on this machine: not tested with it"

.venv-%/.installed: pyproject.toml constraints.txt
	$(FOUND) -m venv --clear $(@D)
	$(@D)/bin/pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[recipes]" pytest
	@touch $@

.venv-%/.tested: .venv-%/.installed FORCE
	$(@D)/bin/python -m pytest -q torchrl_ocwm/modules torchrl_ocwm/objectives tests/training/test_own_recordings.py \
		-k 'not test_recordings_train or simulator'
	rm -r $(@D)

.SECONDARY:

FORCE:

# The documentation site, in site/index.html; `make docs SERVE=1` shows it at http://127.0.0.1:8000 while you write.
docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs $(if $(SERVE),serve,build) --strict

check: $(INSTALLED)
	@$(BIN)/python -m torchrl_ocwm.check

clean:
	rm -rf $(VENV) $(NEXT) $(PYTHONS:%=.venv-%) $(DEMO)

$(INSTALLED): pyproject.toml constraints.txt
	@version=$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
	case "$$version" in 3.10|3.11|3.12) ;; *) \
		echo "make needs Python 3.10, 3.11 or 3.12, for which all simulators have packages; $(PYTHON) is $$version." \
			"Choose another one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1 ;; esac
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

# All packages of the other environment, except for those that are newer.
$(NEXT)/.installed: $(INSTALLED) Makefile
	$(PYTHON) -m venv --clear $(NEXT)
	$(NEXT)/bin/pip install --quiet --disable-pip-version-check --no-deps $(NEXT_VERSIONS)
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
		> "$$($(NEXT)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/others.pth"
	@touch $@

$(DEMO)/dataset/.done:
	$(BIN)/ocwm collect env=reacher policy=scripted steps=$$(($(STEPS) / 2)) workers=$(WORKERS) dataset=$(@D)
	$(BIN)/ocwm collect env=reacher policy=random steps=$(STEPS) workers=$(WORKERS) dataset=$(@D)
	@touch $@

$(DEMO)/focus_lcp/.done: $(DEMO)/dataset/.done
	$(BIN)/ocwm train agent=focus_lcp env=reacher size=cpu \
		dataset=$(<D) output=$(@D) training.updates=$(UPDATES) \
		training.threads=$(WORKERS) training.eval_interval=300 training.video_interval=500
	@touch $@

$(DEMO)/evaluation/.done: $(DEMO)/focus_lcp/.done
	$(BIN)/ocwm evaluate checkpoint=$(<D)/checkpoint.zip goals=100 image_goals=true output=$(@D)
	@touch $@
