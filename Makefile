# make demo | reproduce | test | test-slow | test-notebooks | test-slurm | test-next | lint | docs | bench: each builds what it needs of the environment first.
#
#   PYTHON     the interpreter the environment is made from   (make test PYTHON=python3.11)
#   VENV       where the environment lies
#   PIP_FLAGS  extra options for pip install

PYTHON    ?= python3
VENV      ?= .venv
PIP_FLAGS ?=
BIN       := $(VENV)/bin

# The pins of constraints.txt hold for Python 3.11 and later; 3.10 takes what pip finds.
PINS    = $$($(BIN)/python -c 'import sys; print("-c constraints.txt" if sys.version_info >= (3, 11) else "")')
# Python compiles what is imported, once; pip would compile all. Where the caller forbids Python to
# keep what it compiled, each of the many processes below would compile PyTorch again.
unexport PYTHONDONTWRITEBYTECODE
INSTALL = $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile $(PIP_FLAGS) $(PINS)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo reproduce test test-slow test-notebooks test-slurm test-next lint docs notebooks bench clean $(VENV)

help:  ## list the targets
	@grep -hE '^[a-z][a-z-]*:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "make %-14s %s\n", $$1, $$2 }'

demo: $(VENV)/.installed  ## simulate a soft arm, train three models on it, compare them, control it
	$(BIN)/python train.py -m experiment=demo model=hnn,lnn hydra.sweep.dir=runs/demo
	$(BIN)/python train.py experiment=demo model=mlp loss=increment hydra.run.dir=runs/demo/2_mlp-seed0
	$(BIN)/python evaluate.py 'runs=[runs/demo/*]' step=0.01 hydra.run.dir=runs/demo-evaluation
	$(BIN)/python evaluate.py 'runs=[runs/demo/*]' dataset=soft_arm_1_beyond step=0.01 hydra.run.dir=runs/demo-beyond
	$(BIN)/python control.py experiment=soft_arm_1/regulation gains.position=5 gains.velocity=0.4 rate=500 runs=4 'actuator.low=[-2,-2,-4]' 'actuator.high=[2,2,2]' run=runs/demo/0_hnn-seed0 hydra.run.dir=runs/demo-control
	$(BIN)/python examples/demo_summary.py runs

reproduce: $(VENV)/.installed  ## remake the paper's tables: hours; goes on where it stopped
	$(BIN)/python reproduce.py

test: $(VENV)/.installed-dev  ## run the tests, on all cores
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder -m "not slow"

test-slow: $(VENV)/.installed-notebooks  ## run those left out of make test: compiled models, long simulations and fits, pages, notebooks, SLURM
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder -o norecursedirs='.* build' -m slow

test-notebooks: $(VENV)/.installed-notebooks  ## run the notebooks from clean kernels
	$(BIN)/python -m pytest tests/notebooks --numprocesses auto --dist worksteal

test-slurm: $(VENV)/.installed-dev  ## test a sweep on a real SLURM; needs root, slurm-wlm and munge
	$(BIN)/python -m pytest tests/slurm

test-next: $(VENV)/.installed-dev  ## run the tests of the commands on the next Hydra and OmegaConf
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --upgrade --pre --no-deps --target $(VENV)/next \
	    'hydra-core>=1.4.0rc3,<1.5' 'omegaconf>=2.4.0rc1,<2.5' 'hydra-optuna-sweeper>=1.4.0rc3,<1.5' 'optuna>=4.9,<5'
	PYTHONPATH=$(VENV)/next $(BIN)/python -m pytest tests/app --numprocesses auto --dist loadfile -m "not slow"

lint: $(VENV)/.installed-dev  ## check style, types and import order
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.installed-docs  ## build the documentation into site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

notebooks: $(VENV)/.installed-notebooks  ## run the notebooks and keep what they show
	$(BIN)/jupyter execute --inplace --timeout=900 notebooks/*.ipynb

bench: $(VENV)/.installed-bench  ## time a training step and the simulation of the data
	$(BIN)/python benchmarks/training_step.py
	$(BIN)/python benchmarks/data_generation.py
	$(BIN)/python benchmarks/data_generation.py --dataset soft_arm_2

clean:  ## remove the environment and the caches, keep the runs
	rm -rf $(VENV) build site *.egg-info .pytest_cache .ruff_cache .mypy_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- environment: one stamp per set of packages ---------------------------------------------

$(VENV): $(VENV)/.installed-dev

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# All but the benchmarks by one call of pip, for .ci/run: each call reads what all packages need.
$(VENV)/.installed-all: MORE = dev,docs,notebooks
$(VENV)/.installed-all: STAMPS = $(VENV)/.installed $(addprefix $(VENV)/.installed-,dev docs notebooks)

# PyBullet has Linux wheels for Python 3.10 and 3.11 only; building it from source is not tried.
$(VENV)/.installed $(VENV)/.installed-all: pyproject.toml setup.py constraints.txt | $(BIN)/python
	@echo "installing the packages into $(VENV): runtime $(MORE)"
	@if $(INSTALL) --dry-run --no-deps --only-binary pybullet pybullet >/dev/null 2>&1; then \
	    $(INSTALL) --only-binary pybullet -e '.[panda$(MORE:%=,%)]'; \
	else \
	    echo "no PyBullet wheel for this Python: PyBullet is skipped, MuJoCo simulates the Panda"; \
	    $(INSTALL) -e '.$(MORE:%=[%])'; \
	fi
	@touch $(STAMPS) $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "installing the test and lint tools into $(VENV)"
	@$(INSTALL) -e '.[dev]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	@echo "installing what builds the documentation into $(VENV)"
	@$(INSTALL) -e '.[docs]'
	@touch $@

$(VENV)/.installed-notebooks: $(VENV)/.installed-dev
	@echo "installing what runs the notebooks into $(VENV)"
	@$(INSTALL) -e '.[notebooks]'
	@touch $@

$(VENV)/.installed-bench: $(VENV)/.installed
	@echo "installing what the benchmarks compare with into $(VENV)"
	@$(INSTALL) -e '.[bench]'
	@touch $@
