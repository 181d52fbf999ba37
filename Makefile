# Every target makes its own environment first: a fresh clone + `make demo` or `make test` is all the set-up there is.
PYTHON ?= python3
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
NATIVE := $(shell find rtgs/native -name "*.cpp" -o -name "*.h" -o -name "*.cmake") CMakeLists.txt pyproject.toml
RUN ?=
MINUTES ?= 30
FIRST ?= 0
# of the tables: PRESET smoke quick standard paper; SEEDS how many; DATA stand_in ref_real nu_nerf (with DATA_ROOT); WORKERS
PRESET ?= quick
SEEDS ?= 1
DATA ?= stand_in
WORKERS ?= 2
DATA_ROOT ?= data
export DATA_ROOT
comma := ,
empty :=
space := $(empty) $(empty)
SEED_LIST = seed=$(subst $(space),$(comma),$(shell seq 0 $$(($(SEEDS) - 1))))
SCENES_ref_real := scene=ref_real/sedan,ref_real/gardenspheres,ref_real/toycar
SCENES_nu_nerf := scene=nu_nerf/ballstatue,nu_nerf/popcorncup,nu_nerf/real_bottle,nu_nerf/tall_bottle
# with the papers' data: what is missing is listed with where it belongs, and nothing starts, unless RUN names the scenes
SOME_SCENES = $(findstring scene=,$(RUN))
CHECK_DATA = $(if $(filter-out stand_in,$(DATA)),$(if $(SOME_SCENES),,$(BIN)/rtgs check data=$(DATA) $(SCENES_$(DATA))))
# recipes expand this first; its argument is the dataset of the table's paper scenes
of_data = $(if $(filter stand_in $(1),$(DATA)),,$(error DATA=$(DATA): this table is of stand_in or $(1)))
DATA_WORDS = $(if $(SOME_SCENES),,$(SCENES_$(DATA))) $(if $(filter-out stand_in,$(DATA)),table.data=paper)
# another launcher comes with options of its own: RUN='hydra/launcher=rtgs_cluster', RUN='hydra/launcher=joblib threads=1'
WORKER_WORDS = $(if $(findstring hydra/launcher=,$(RUN)),,hydra.launcher.workers=$(WORKERS))
TABLE = $(BIN)/rtgs run preset=$(PRESET) $(SEED_LIST) $(WORKER_WORDS) $(DATA_WORDS)

.DEFAULT_GOAL := help
.PHONY: help setup demo test fuzz e2e bench lint format docs dashboard accept-steps contact-sheet clean
.PHONY: reproduce-table1 reproduce-table2 reproduce-table3 reproduce-fig-split-sum

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-24s %s\n", $$1, $$2}'

setup: $(READY) ## make .venv with everything, native core built

$(READY): $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "rtgs needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo not there). Try: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@command -v "$${CXX:-c++}" >/dev/null || \
	  { echo "rtgs builds a native core and found no C++ compiler ('$${CXX:-c++}'). Install one: Debian/Ubuntu 'apt install g++', Fedora 'dnf install gcc-c++', macOS 'xcode-select --install'; or set CXX."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --upgrade pip
	$(BIN)/pip install -q "$(TORCH)"
	$(BIN)/pip install -q -e '.[dev,prepare,synthetic]'
	@touch $(READY)

demo: setup ## train the embedded glass scene, end with a page of pictures and numbers (about 5 minutes)
	$(BIN)/rtgs run scene=demo method=rtgs preset=quick $(RUN)

reproduce-table1: setup ## mirrors: every method on every scene, ends with tables/table1-PRESET (PRESET= SEEDS= DATA= WORKERS=)
	$(call of_data,ref_real)$(CHECK_DATA)
	$(TABLE) experiment=table1 $(RUN)

reproduce-table2: setup ## thin glass: the same for Table 2
	$(call of_data,nu_nerf)$(CHECK_DATA)
	$(TABLE) experiment=table2 $(RUN)

reproduce-table3: SCENES_nu_nerf := scene=nu_nerf/ballstatue
reproduce-table3: setup ## what each part of the third stage is worth
	$(call of_data,nu_nerf)$(CHECK_DATA)
	$(TABLE) experiment=table3 $(RUN)

reproduce-fig-split-sum: SCENES_ref_real := scene=ref_real/sedan
reproduce-fig-split-sum: setup ## microfacet weight against split-sum shading
	$(call of_data,ref_real)$(CHECK_DATA)
	$(TABLE) experiment=fig_split_sum $(RUN)

test: setup ## the tests
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow"

fuzz: setup ## damaged files against every reader for MINUTES, ends with counts (FIRST= number of the first input)
	$(BIN)/python -m tests.fuzz.attack --minutes $(MINUTES) --first $(FIRST)

e2e: setup ## long end-to-end runs
	$(BIN)/python -m pytest -m slow

bench: setup ## speed and error figures, each a JSON object on its last line
	$(BIN)/python -m benchmarks.speed.raster
	$(BIN)/python -m benchmarks.speed.losses
	$(BIN)/python -m benchmarks.speed.gaussians
	$(BIN)/python -m benchmarks.speed.train_step
	$(BIN)/python -m benchmarks.speed.speed_error --quick

lint: setup ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: setup ## let ruff put things right
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup ## docs/api.md: the reference of what rtgs exports, from its docstrings
	$(BIN)/python docs/make_api.py

dashboard: setup ## browse the runs in MLflow on this machine (loopback)
	$(BIN)/rtgs dashboard

accept-steps: setup ## accept the changed source of pipeline steps (after bumping a version, or when the output is the same)
	$(BIN)/python -m tests.pipelines.accept_steps

contact-sheet: setup ## docs/images/scenes.jpg: every path-traced scene with its layers; prints their figures
	$(BIN)/python -m rtgs.scenes.contact_sheet docs/images/scenes.jpg

clean: ## remove the environment and build products (not the store)
	rm -rf $(VENV) build
