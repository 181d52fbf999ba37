# Every target makes its own environment first: a fresh clone + `make demo` or `make test` is all the set-up there is.
PYTHON ?= python3
TORCH ?= torch==2.13.0
# asked first: on Linux the package index would bring torch for CUDA, gigabytes of it; TORCH_INDEX= asks the latter alone
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# an image installs for good, with more: EDITABLE= EXTRAS=prepare,sweeps,cluster,server
EDITABLE ?= -e
EXTRAS ?= prepare,sweeps
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready_dev
NATIVE := $(shell find rtgs/native -name "*.cpp" -o -name "*.h" -o -name "*.cmake") CMakeLists.txt pyproject.toml
RUN ?=
MINUTES ?= 30
FIRST ?= 0
HOURS ?= 1
# of the tables: PRESET smoke quick standard paper (PRESETS several, of time-quality); SEEDS how many; DATA stand_in ref_real nu_nerf (with DATA_ROOT); WORKERS (0: by cores, memory and jobs)
PRESET ?= quick
SEEDS ?= 1
DATA ?= stand_in
PRESETS ?= quick,standard
WORKERS ?= 0
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
.PHONY: help setup setup-dev demo test fuzz sanitize soak e2e bench lint format docs dashboard accept-steps contact-sheet web clean
.PHONY: reproduce-table1 reproduce-table2 reproduce-table3 reproduce-fig-split-sum reproduce-figures
.PHONY: reproduce-time-quality

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-24s %s\n", $$1, $$2}'

setup: $(READY) ## make .venv with what a user needs, native core built

setup-dev: $(READY_DEV) ## the same, and what tests and development need

$(READY): $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "rtgs needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo not there). Try: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@command -v "$${CXX:-c++}" >/dev/null || \
	  { echo "rtgs builds a native core and found no C++ compiler ('$${CXX:-c++}'). Install one: Debian/Ubuntu 'apt install g++', Fedora 'dnf install gcc-c++', macOS 'xcode-select --install'; or set CXX."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --upgrade pip
	$(if $(TORCH_INDEX),$(BIN)/pip install -q --index-url $(TORCH_INDEX) --timeout 5 --retries 0 "$(TORCH)" || \
	  { echo "$(TORCH_INDEX) gives no $(TORCH): taking what pip finds (on Linux it may be for CUDA)."; $(BIN)/pip install -q "$(TORCH)"; },$(BIN)/pip install -q "$(TORCH)")
	$(BIN)/pip install -q $(EDITABLE) '.[$(EXTRAS)]'
	@touch $(READY)
	@echo "$(VENV) takes $$(du -sh $(VENV) | cut -f1)B"

$(READY_DEV): $(READY)
	$(BIN)/pip install -q -e '.[dev,prepare,sweeps,synthetic]'
	@touch $(READY_DEV)
	@echo "$(VENV) takes $$(du -sh $(VENV) | cut -f1)B"

demo: setup ## train the embedded glass scene, end with a page of pictures and numbers (a minute and a half)
	$(BIN)/rtgs run scene=demo method=rtgs preset=quick steps_scaler=0.5 $(RUN)

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

.PHONY: figures-data
figures-data: # before anything is trained
	$(if $(filter stand_in,$(DATA)),,$(error DATA=$(DATA): conf/figure is of the shipped stand-ins; make the table with DATA, and draw it by a figure file of its scenes and views: rtgs figures FILE preset=$(PRESET)))

reproduce-figures: figures-data reproduce-table1 reproduce-table2 reproduce-table3 reproduce-fig-split-sum ## panels of pictures, PNG and PDF, from the runs of all tables (PRESET=)
	$(BIN)/rtgs figures preset=$(PRESET)

reproduce-time-quality: PRESET := $(PRESETS)
reproduce-time-quality: setup ## PSNR over CPU time for every method and preset, a plot for each scene (PRESETS= DATA= WORKERS=)
	$(CHECK_DATA)
	$(TABLE) experiment=time_quality $(RUN)

test: setup-dev ## the tests
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

fuzz: setup-dev ## damaged files against every reader for MINUTES, ends with counts (FIRST= number of the first input)
	$(BIN)/python -m tests.fuzz.attack --minutes $(MINUTES) --first $(FIRST)

sanitize: setup-dev ## native tests under ASan and UBSan, portable and AVX-512 (RUN="--isa portable")
	$(BIN)/python -m tests.native.sanitize $(RUN)

soak: setup-dev ## runs killed, out of disk, racing and with damaged artifacts for HOURS; all must end the same, bit for bit
	$(BIN)/python -m benchmarks.quality.soak --hours $(HOURS)

e2e: setup-dev ## long end-to-end runs
	$(BIN)/python -m pytest -m slow

bench: setup-dev ## speed and error figures, each a JSON object on its last line
	$(BIN)/python -m benchmarks.speed.raster
	$(BIN)/python -m benchmarks.speed.losses
	$(BIN)/python -m benchmarks.speed.gaussians
	$(BIN)/python -m benchmarks.speed.train_step
	$(BIN)/python -m benchmarks.speed.speed_error --quick

lint: setup-dev ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: setup-dev ## let ruff put things right
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup-dev ## docs/api.md from the docstrings of what rtgs exports, then all pages as a site: build/site/index.html
	$(BIN)/python docs/make_api.py
	$(BIN)/python docs/make_site.py build/site

dashboard: setup ## browse the runs in MLflow on this machine (loopback)
	$(BIN)/rtgs dashboard

accept-steps: setup-dev ## accept the changed source of pipeline steps (after bumping a version, or when the output is the same)
	$(BIN)/python -m tests.pipelines.accept_steps

contact-sheet: setup-dev ## docs/images/scenes.jpg: every path-traced scene with its layers; prints their figures
	$(BIN)/python -m rtgs.scenes.contact_sheet docs/images/scenes.jpg

web: ## rtgs/export/web/vendor.js.gz: three.js and Spark for exported pages, with npm, from fixed versions
	rm -rf build/web && mkdir -p build/web && cp $(addprefix rtgs/export/web/,package.json package-lock.json vendor.js) build/web
	cd build/web && npm ci --no-audit --no-fund && node_modules/.bin/esbuild vendor.js --bundle --minify --format=esm \
		--legal-comments=none --outfile=out.js && gzip -9 -n -c out.js > ../../rtgs/export/web/vendor.js.gz

clean: ## remove the environment and build products (not the store)
	rm -rf $(VENV) build
