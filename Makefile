# Every target works alone in a fresh clone, with nothing but Python 3.10+ and make.

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
# One thread a process: fastest at these sizes, and parallel tests do not fight over cores.
export OMP_NUM_THREADS ?= 1
export MUJOCO_GL ?= disabled

.DEFAULT_GOAL := help
.PHONY: help install demo demo-llm study report test test-slow test-faults lint format types docs clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# The stamp is newer than what it was made from, so a second call starts at once.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "Python 3.10 or newer is needed; name one with PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV), once; this takes some minutes."
	$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

install: $(VENV)/.installed ## make .venv with everything that is tested

DEMO := 'stack=["loss=ecpo seed=1,2,3","loss=urex loss.tau=0.5 loss.score=batch epochs=4 seed=1,2,3",$\
	"loss=dr_grpo loss.clip_epsilon=0.15 loss.score=batch optim.lr=0.01 epochs=4 max_kl=0.3 seed=1,2,3"]'

demo: install ## compare ECPO, UREX and Dr.GRPO on Reverse, and ECPO, UREX and MENT on the 10,000-armed bandit
	$(RUN) sota-implementations/ecpo/ecpo.py env=reverse $(DEMO) total_trajectories=56000 \
		hydra.run.dir=runs/demo/reverse
	$(RUN) sota-implementations/ecpo/ecpo.py env=bandit \
		'stack=["loss=ecpo,urex,ment seed=1,2,3"]' hydra.run.dir=runs/demo/bandit
	@$(RUN) -m torchrl_ecpo.experiment.compare runs/demo/reverse --title Reverse
	@$(RUN) -m torchrl_ecpo.experiment.compare runs/demo/bandit --title "10,000-armed bandit"

demo-llm: install ## teach a small language model Countdown by ECPO and by GRPO, and draw its pass@64
	$(RUN) sota-implementations/llm/llm.py --multirun env=countdown loss=ecpo,grpo \
		hydra.sweep.dir=runs/demo/llm
	@$(RUN) -m torchrl_ecpo.experiment.compare runs/demo/llm --metric pass_at_64 \
		--title "Countdown" --x-label "completions"

study: install ## make the runs of the study that are not in runs/study; ARGS='--missing', ARGS='--only figure1 --seeds 1-3'
	$(RUN) sota-implementations/study/run.py $(ARGS)

report: install ## write docs/study.md from committed results; RUNS=runs/study takes runs in first
	$(if $(RUNS),$(RUN) sota-implementations/study/collect.py $(RUNS))
	$(RUN) sota-implementations/study/report.py

# By file: what the tests of a file share is made once.
test: install ## run every test that takes less than some ten seconds
	$(RUN) -m pytest -n auto --dist loadfile -q

test-slow: install ## run the tests that take longer
	$(RUN) -m pytest -n auto -q -m slow

test-faults: install ## kill runs at random moments, damage checkpoints, fill a disk, and resume
	$(RUN) -m pytest -q -m slow test/test_faults.py

lint: install ## check style and formatting
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

format: install ## mend style and formatting
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

types: install ## check types
	$(RUN) -m pyright

docs: install ## build the documentation, without a warning, into docs/_build/html
	$(RUN) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

clean: ## remove the environment and everything that was generated
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis docs/_build runs outputs multirun
