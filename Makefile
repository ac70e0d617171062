# make help lists the targets.

PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3)
VENV := .venv
RUN_PYTHON := $(VENV)/bin/python
STAGES := frames body field mesh texture export report

# Inputs of a run; all are optional.
VIDEO ?=
RUN ?=
PRESET ?=
SET ?=
EXTRA ?=
ARGS ?=

# Inputs of pose; all are optional.
BVH ?=
FRAME ?=
POSE ?=
NAME ?=

# Input of film besides NAME; optional.
CLIP ?=

# Inputs of retexture and stylise besides NAME.
DIFFUSE ?=
FROM ?=
MASK ?=
LOOK ?=

# Input of reshape besides NAME.
SHAPE ?=

# Inputs of a batch.
VIDEOS ?=
RUNS ?= runs
JOBS ?=
CLUSTER ?=

# Inputs of the chart; all are optional.
CAPTURES ?=
PRESETS ?=
SEEDS ?=

# Inputs of the ablations besides CAPTURES or RUN and SEEDS, and of the stress test; optional.
ROWS ?=

# bench-field: file for its figures, and runs of another preset for comparison (RUN may then name several runs).
JSON ?=
BASELINE ?=

# Tests: worker processes, each with one thread of OpenMP. TEST_JOBS=0 runs them in one process with all threads.
TEST_JOBS ?= 2
PYTEST := $(if $(filter 0,$(TEST_JOBS)),,OMP_NUM_THREADS=1) $(RUN_PYTHON) -m pytest -n $(TEST_JOBS) --dist loadfile

TORCH_VERSION := 2.13.0
GLTF_VALIDATOR_VERSION := 2.0.0-dev.3.10
SAMPLE_RUN := runs/sample
SAMPLE := runs/sample-capture
SAMPLE_DONE := $(SAMPLE)/.done-$(shell sed -n 's/^CAPTURE_VERSION = //p' data_tools/synthetic/scene/capture.py)
ONE_RUN := $(or $(RUN),$(SAMPLE_RUN))
# An argument of the shell, whatever characters are in it.
quoted = '$(subst ','\'',$(1))'
SET_OPTIONS = $(foreach item,$(SET),$(if $(findstring =,$(item)),--set $(call quoted,$(item)),$(error SET=$(SET): $(item) has no '='; a value with spaces goes through ARGS='--set "key=a value"')))
RUN_OPTIONS = $(if $(PRESET),--preset $(call quoted,$(PRESET))) $(SET_OPTIONS)
OPTIONS = $(RUN_OPTIONS) $(ARGS)
STAMP := $(VENV)/.stamp$(if $(EXTRA),-$(EXTRA))

.DEFAULT_GOAL := help
.PHONY: help all $(STAGES) batch chart ablate ablate-field stress pose film retexture stylise reshape compare figures materials test test-all check format bench bench-field bench-body bench-way doctor venv lock configs gltf-validator clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z$$()A-Z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST) | sed 's/$$(STAGES)/STAGE    /'
	@echo "  STAGE is one of: $(STAGES)"
	@echo "  variables: VIDEO=file-or-folder RUN=runs/name PRESET=instant|default|fine SET='mesh.key=value'"
	@echo "             EXTRA=cuda (an NVIDIA GPU), cluster (Snakemake), usdz or web (export.formats)"

ifeq ($(VIDEO)$(RUN),)
all: $(STAMP) $(SAMPLE_DONE)  ## run all stages; without VIDEO: on a generated sample with known ground truth
	$(RUN_PYTHON) -m stages --run $(SAMPLE_RUN) --video $(SAMPLE)/video $(OPTIONS)
else
all: $(STAMP)
	$(RUN_PYTHON) -m stages $(if $(RUN),--run "$(RUN)") $(if $(VIDEO),--video "$(VIDEO)") $(OPTIONS)
endif

$(STAGES): $(STAMP)  ## run one stage of RUN=runs/name
	$(RUN_PYTHON) -m stages $@ "$(ONE_RUN)" $(if $(VIDEO),--video "$(VIDEO)") $(OPTIONS)

batch: $(STAMP)  ## run all videos of VIDEOS=folder, JOBS=n at a time, or with CLUSTER=local|slurm|kubernetes
	@test -n "$(VIDEOS)" || { echo "error: no folder of videos: make $@ VIDEOS=folder" >&2; exit 2; }
ifeq ($(CLUSTER),)
	$(RUN_PYTHON) -m data_tools.sweep.batch "$(VIDEOS)" --runs "$(RUNS)" $(if $(JOBS),--jobs $(JOBS)) $(OPTIONS)
else
	@test -x $(VENV)/bin/snakemake || { echo "error: Snakemake is not installed: make venv EXTRA=cluster" >&2; exit 2; }
	$(VENV)/bin/snakemake --snakefile configs/cluster/Snakefile --profile configs/cluster/$(CLUSTER) \
		$(if $(JOBS),--jobs $(JOBS)) $(ARGS) --config videos="$(VIDEOS)" runs="$(RUNS)" project="$(CURDIR)" \
		python="$(CURDIR)/$(RUN_PYTHON)" options=$(call quoted,$(RUN_OPTIONS))
endif

chart: $(STAMP)  ## plot accuracy against time of PRESETS on CAPTURES with SEEDS (default: all presets, two generated people)
	$(RUN_PYTHON) -m data_tools.sweep.chart $(CAPTURES) $(if $(PRESETS),--presets $(PRESETS)) $(if $(SEEDS),--seeds $(SEEDS)) \
		$(SET_OPTIONS) $(ARGS)

ablate: $(STAMP)  ## remove, replace or add one part of stage two, or change its sizes: ROWS, CAPTURES, SEEDS (default: all, the sample, 0 1 2)
	$(RUN_PYTHON) -m data_tools.sweep.ablate $(CAPTURES) $(if $(ROWS),--rows $(ROWS)) $(if $(SEEDS),--seeds $(SEEDS)) $(ARGS)

ablate-field: $(STAMP)  ## change one size or part of the field stage on finished runs: RUN='runs/a runs/b', ROWS, SEEDS
	$(RUN_PYTHON) -m data_tools.sweep.ablate_field $(ONE_RUN) $(if $(ROWS),--rows $(ROWS)) $(if $(SEEDS),--seeds $(SEEDS)) $(ARGS)

stress: $(STAMP)  ## test stability where such methods fail: ROWS='focal seeds' (default: all); exit status 1 if a line is crossed
	$(RUN_PYTHON) -m data_tools.stress $(if $(ROWS),--rows $(ROWS)) $(ARGS)

# Made once; a sample that is incomplete (without .done) or of another version is made again.
$(SAMPLE_DONE): | $(STAMP)
	rm -rf $(SAMPLE)
	$(RUN_PYTHON) -m data_tools.sample $(SAMPLE)
	@touch $@

pose: $(STAMP)  ## play BVH='clip.bvh ...' on the avatar of RUN=runs/name, or pose it by FRAME=12 or POSE=a|t|file.json
	$(RUN_PYTHON) -m data_tools.pose "$(ONE_RUN)" $(foreach clip,$(BVH),--bvh "$(clip)") $(if $(FRAME),--frame $(FRAME)) \
		$(if $(POSE),--pose "$(POSE)") $(if $(NAME),--name "$(NAME)") $(ARGS)

film: $(STAMP)  ## render the turntable of RUN=runs/name, or CLIP=capture|idle|clip.bvh, to RUN/film/NAME/film.mp4
	$(RUN_PYTHON) -m data_tools.film "$(ONE_RUN)" $(if $(CLIP),--clip "$(CLIP)") $(if $(NAME),--name "$(NAME)") $(ARGS)

retexture: $(STAMP)  ## give the avatar of RUN=runs/name the texture DIFFUSE=paint.png, or that of FROM=runs/other where MASK=image.png is white
	$(RUN_PYTHON) -m data_tools.retexture "$(ONE_RUN)" $(if $(DIFFUSE),--diffuse "$(DIFFUSE)") $(if $(FROM),--from "$(FROM)") \
		$(if $(MASK),--mask "$(MASK)") $(if $(NAME),--name "$(NAME)") $(ARGS)

stylise: $(STAMP)  ## give the avatar of RUN=runs/name the palette of LOOK=image.png
	$(RUN_PYTHON) -m data_tools.stylise "$(ONE_RUN)" $(if $(LOOK),--look "$(LOOK)") $(if $(NAME),--name "$(NAME)") $(ARGS)

reshape: $(STAMP)  ## give the avatar of RUN=runs/name another shape: SHAPE='weight=+0.2 height=-0.1'
	$(RUN_PYTHON) -m data_tools.reshape "$(ONE_RUN)" --shape "$(SHAPE)" $(if $(NAME),--name "$(NAME)") $(ARGS)

compare: $(STAMP)  ## compare RUN=runs/name with the ground truth of TRUTH=capture (default: the sample): compare/truth.html
	$(RUN_PYTHON) -m data_tools.evaluate.compare "$(or $(TRUTH),$(SAMPLE))" "$(ONE_RUN)"

figures: $(STAMP)  ## measure every table of README and docs on this commit: CAPTURES, PRESETS
	$(RUN_PYTHON) -m data_tools.sweep.figures $(CAPTURES) $(if $(PRESETS),--presets $(PRESETS)) $(ARGS)

materials: $(STAMP)  ## measure light, albedo and highlights against the truth: CAPTURES, SEEDS, ARGS="--mesh true run"
	$(RUN_PYTHON) -m data_tools.sweep.materials $(CAPTURES) $(if $(SEEDS),--seeds $(SEEDS)) $(ARGS)

test: $(STAMP)  ## run the fast tests in TEST_JOBS=2 processes
	$(PYTEST) -m "not slow" $(ARGS)

test-all: $(STAMP)  ## run all tests
	$(PYTEST) $(ARGS)

check: $(STAMP)  ## check lint, format, types and import rules
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

format: $(STAMP)  ## apply the fixes of ruff
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

bench: bench-field  ## bench-field, then the kernels alone; run nothing else at the same time
	$(RUN_PYTHON) -m tests.bench.bench_kernels $(if $(JSON),--json "$(basename $(JSON))-kernels.json")

bench-field: $(STAMP)  ## time each part of a training step: RUN=runs/name or a painted body; JSON=file
	$(RUN_PYTHON) -m tests.bench.bench_field $(if $(RUN),--run $(RUN)) $(if $(PRESET),--preset $(call quoted,$(PRESET))) \
		$(if $(BASELINE),--baseline $(BASELINE)) $(if $(JSON),--json "$(JSON)") $(ARGS)

bench-body: $(STAMP)  ## compare frames and body with the ground truth of synthetic CAPTURES
	$(RUN_PYTHON) -m tests.bench.bench_body $(CAPTURES) $(ARGS)

bench-way: $(STAMP)  ## time each stage of the finished run RUN=runs/name and its parts; JSON=file
	$(RUN_PYTHON) -m tests.bench.bench_way "$(ONE_RUN)" $(if $(JSON),--json "$(JSON)") $(ARGS)

doctor:  ## check the requirements of this machine
	@$(PYTHON) -m scripts.doctor

venv: $(STAMP)  ## install the pinned dependencies into .venv (EXTRA=cuda for an NVIDIA GPU)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -m scripts.doctor
	@test -x $(RUN_PYTHON) || $(PYTHON) -m venv $(VENV)
	$(RUN_PYTHON) -m scripts.install requirements.lock $(EXTRA)
	@echo "preparing kernels and body model, once on this machine"
	$(RUN_PYTHON) -m stages --prepare
	@touch $@

# pip must find the CPU build of torch (TORCH_INDEX=https://download.pytorch.org/whl/cpu unless another index offers it):
# the CUDA build would add its own packages to the lock file.
lock:  ## write requirements.lock from pyproject.toml
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/python -m pip install --quiet $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch==$(TORCH_VERSION) ".[dev]"
	echo "# Written by make lock: full resolution of pyproject.toml with its dev extra." > build/requirements.lock
	build/lock/bin/python -m pip freeze --exclude instant-human-mesh | sed 's/+cpu$$//' >> build/requirements.lock
	mv build/requirements.lock requirements.lock

configs: $(STAMP)  ## write configs/default.yaml from the defaults in code
	$(RUN_PYTHON) -m stages --defaults > configs/default.yaml.new
	mv configs/default.yaml.new configs/default.yaml

gltf-validator: node_modules/gltf-validator  ## install the Khronos validator for the tests (needs npm)

node_modules/gltf-validator:
	npm install --no-save --no-audit --no-fund --loglevel=error gltf-validator@$(GLTF_VALIDATOR_VERSION)

clean:  ## remove caches and builds, not runs/ and .venv
	rm -rf build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
