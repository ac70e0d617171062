# make help says what there is.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
RUN_PYTHON := $(VENV)/bin/python
STAGES := frames body field mesh texture export report

# What a run is made of; all may be left out.
VIDEO ?=
RUN ?=
PRESET ?=
SET ?=
EXTRA ?=
ARGS ?=

# Many videos.
VIDEOS ?=
RUNS ?= runs
JOBS ?=
CLUSTER ?=

# What the chart compares; all may be left out.
CAPTURES ?=
PRESETS ?=
SEEDS ?=

# Where bench-field writes its figures, and the runs of another preset that RUN, here also several, is compared with.
JSON ?=
BASELINE ?=

TORCH_VERSION := 2.13.0
GLTF_VALIDATOR_VERSION := 2.0.0-dev.3.10
SAMPLE_RUN := runs/sample
SAMPLE := runs/sample-capture
SAMPLE_MADE := $(SAMPLE)/.done-$(shell sed -n 's/^CAPTURE_VERSION = //p' data_tools/synthetic/scene/capture.py)
ONE_RUN := $(or $(RUN),$(SAMPLE_RUN))
RUN_OPTIONS = $(if $(PRESET),--preset $(PRESET)) $(foreach item,$(SET),--set $(item))
OPTIONS = $(RUN_OPTIONS) $(ARGS)
STAMP := $(VENV)/.stamp$(if $(EXTRA),-$(EXTRA))

.DEFAULT_GOAL := help
.PHONY: help all $(STAGES) batch chart compare figures test test-all check format bench bench-field bench-body doctor venv lock configs gltf-validator clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z$$()A-Z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST) | sed 's/$$(STAGES)/STAGE    /'
	@echo "  STAGE is one of: $(STAGES)"
	@echo "  variables: VIDEO=file-or-folder RUN=runs/name PRESET=instant|default|fine SET='mesh.key=value'"
	@echo "             EXTRA=cuda (a graphics card) or EXTRA=cluster (Snakemake)"

ifeq ($(VIDEO)$(RUN),)
all: $(STAMP) $(SAMPLE_MADE)  ## the whole way; without VIDEO: a generated sample with known truth
	$(RUN_PYTHON) -m stages --run $(SAMPLE_RUN) --video $(SAMPLE)/video $(OPTIONS)
else
all: $(STAMP)
	$(RUN_PYTHON) -m stages $(if $(RUN),--run "$(RUN)") $(if $(VIDEO),--video "$(VIDEO)") $(OPTIONS)
endif

$(STAGES): $(STAMP)  ## one stage of RUN=runs/name
	$(RUN_PYTHON) -m stages.$@ "$(ONE_RUN)" $(if $(VIDEO),--video "$(VIDEO)") $(OPTIONS)

batch: $(STAMP)  ## all videos of VIDEOS=folder, with a table; JOBS=n at once, or CLUSTER=local|slurm|kubernetes
	@test -n "$(VIDEOS)" || { echo "error: no folder of videos: make $@ VIDEOS=folder" >&2; exit 2; }
ifeq ($(CLUSTER),)
	$(RUN_PYTHON) -m data_tools.sweep.batch "$(VIDEOS)" --runs "$(RUNS)" $(if $(JOBS),--jobs $(JOBS)) $(OPTIONS)
else
	@test -x $(VENV)/bin/snakemake || { echo "error: Snakemake is not installed: make venv EXTRA=cluster" >&2; exit 2; }
	$(VENV)/bin/snakemake --snakefile configs/cluster/Snakefile --profile configs/cluster/$(CLUSTER) \
		$(if $(JOBS),--jobs $(JOBS)) $(ARGS) --config videos="$(VIDEOS)" runs="$(RUNS)" project="$(CURDIR)" \
		python="$(CURDIR)/$(RUN_PYTHON)" options="$(RUN_OPTIONS)"
endif

chart: $(STAMP)  ## accuracy against seconds: PRESETS over CAPTURES (all presets, two generated people) with SEEDS
	$(RUN_PYTHON) -m data_tools.sweep.chart $(CAPTURES) $(if $(PRESETS),--presets $(PRESETS)) $(if $(SEEDS),--seeds $(SEEDS)) $(ARGS)

# Made once; one that is half-made, which has no .done, or of another version is made anew.
$(SAMPLE_MADE): | $(STAMP)
	rm -rf $(SAMPLE)
	$(RUN_PYTHON) -m data_tools.sample $(SAMPLE)
	@touch $@

compare: $(STAMP)  ## RUN=runs/name against the ground truth of TRUTH=capture (default: the sample): compare/truth.html
	$(RUN_PYTHON) -m data_tools.evaluate.compare "$(or $(TRUTH),$(SAMPLE))" "$(ONE_RUN)"

figures: $(STAMP)  ## measure every table of README and docs on this commit: CAPTURES, PRESETS
	$(RUN_PYTHON) -m data_tools.sweep.figures $(CAPTURES) $(if $(PRESETS),--presets $(PRESETS)) $(ARGS)

test: $(STAMP)  ## the fast tests, with the skip count
	$(RUN_PYTHON) -m pytest -m "not slow" $(ARGS)

test-all: $(STAMP)  ## all tests, the slow ones too
	$(RUN_PYTHON) -m pytest $(ARGS)

check: $(STAMP)  ## lint, format, types, import layers
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

format: $(STAMP)  ## mend what ruff can mend
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

bench: bench-field  ## bench-field, then the kernels alone; the machine should do nothing else
	$(RUN_PYTHON) -m tests.bench.bench_kernels $(if $(JSON),--json "$(basename $(JSON))-kernels.json")

bench-field: $(STAMP)  ## each part of a training step beside its floor: RUN=runs/name or a painted body; JSON=file
	$(RUN_PYTHON) -m tests.bench.bench_field $(if $(RUN),--run $(RUN)) $(if $(PRESET),--preset $(PRESET)) \
		$(if $(BASELINE),--baseline $(BASELINE)) $(if $(JSON),--json "$(JSON)") $(ARGS)

bench-body: $(STAMP)  ## frames and body against the truth of CAPTURES that data_tools made
	$(RUN_PYTHON) -m tests.bench.bench_body $(CAPTURES) $(ARGS)

doctor:  ## what this machine lacks, and the command that mends it
	@$(PYTHON) -m scripts.doctor

venv: $(STAMP)  ## install the pinned dependencies into .venv (EXTRA=cuda for a graphics card)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -m scripts.doctor
	@test -x $(RUN_PYTHON) || $(PYTHON) -m venv $(VENV)
	$(RUN_PYTHON) -m scripts.install requirements.lock $(EXTRA)
	@touch $@

# The CPU build must be the one that pip sees (TORCH_INDEX=https://download.pytorch.org/whl/cpu where PyPI is all there
# is): the CUDA build would fill the lock file with its own packages.
lock:  ## resolve pyproject.toml anew into requirements.lock
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/python -m pip install --quiet $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch==$(TORCH_VERSION) ".[dev]"
	echo "# Written by make lock: the full resolution of pyproject.toml with its dev extra." > build/requirements.lock
	build/lock/bin/python -m pip freeze --exclude instant-human-mesh | sed 's/+cpu$$//' >> build/requirements.lock
	mv build/requirements.lock requirements.lock

configs: $(STAMP)  ## write configs/default.yaml from the defaults in code
	$(RUN_PYTHON) -m stages --defaults > configs/default.yaml.new
	mv configs/default.yaml.new configs/default.yaml

gltf-validator: node_modules/gltf-validator  ## install the Khronos validator for the tests (needs npm)

node_modules/gltf-validator:
	npm install --no-save --no-audit --no-fund --loglevel=error gltf-validator@$(GLTF_VALIDATOR_VERSION)

clean:  ## remove caches and builds; runs/ and .venv stay
	rm -rf build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
