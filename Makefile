# The ground floor. A newcomer needs python3 (3.11 to 3.13) with venv, and make; everything else is set up here.
#   make demo    the whole system at debug size, from a seed to a report page
#   make test    the tests of xew; parity with other libraries by stored arrays. make test TESTS=tests/metrics for one package
#   make test-lab   what make test leaves out: lab/, live parity with PyTorch, diffusers and transformers, long tests
#   make test-faults   hostile and broken inputs, kills, full disks: all of tests/faults, with the counts of what was tried
#   make docs    the site of the documentation, site/index.html
#   make test-fresh   the README's quickstart with the wheel and the newest releases of everything, in a fresh environment of each Python that
#                     is there; make test-lab does it by one Python at the versions of requirements/test.txt
#   make lint    ruff and mypy
#   make setup   only the environment (.venv, at the versions of requirements/test.txt)

PYTHON ?= python3
WORKERS ?= 2
DEMO ?= demo
BIN := .venv/bin
STAMP := .venv/.installed
REFERENCE := .venv/.reference
DOCS := .venv/.docs

.PHONY: setup demo test test-lab test-faults test-fresh docs lint clean
.DELETE_ON_ERROR:

setup: $(STAMP)

$(STAMP): pyproject.toml requirements/test.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "xew needs Python 3.11 to 3.13, found `$(PYTHON) --version`; name another: make PYTHON=python3.12 setup"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check -c requirements/test.txt -e '.[dev]'
	touch $@

$(REFERENCE): $(STAMP)
	$(BIN)/python -m pip install --disable-pip-version-check -c requirements/test.txt -e '.[dev,reference]'
	SAM2_BUILD_CUDA=0 $(BIN)/python -m pip install --disable-pip-version-check --no-deps --no-build-isolation sam2==1.1.0
	touch $@

# One thread a worker in the numerical libraries: two workers with a pool each only wait for one another. A file stays with one
# worker, since its tests share what they make, and long files come first (tests/conftest.py orders them).
TESTS ?=
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(PYTEST) -m "not lab" $(TESTS)

test-lab: $(REFERENCE)
	XEW_GOLDEN=live $(PYTEST) -m "lab or parity" $(TESTS)

test-faults: $(STAMP)
	XEW_ALL_FAULTS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/faults

$(DOCS): $(STAMP) requirements/docs.txt
	$(BIN)/python -m pip install --disable-pip-version-check -c requirements/test.txt -c requirements/docs.txt -e '.[dev,docs]'
	touch $@

# Any warning, such as of a link or a name that leads nowhere, ends it (with --quiet none would be counted). The package is read and not imported.
docs: $(DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "The site is at site/index.html; its search works when it is served, as by $(BIN)/python -m http.server -d site"

test-fresh: $(STAMP)
	$(BIN)/python -m benchmarks.fresh_environments

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Seed -> episodes -> latents -> checkpoint -> rollouts -> scores -> report. Each step skips what is done already. Six scenes, three a
# task, are the fewest that have intervals; rolled out are the two unseen robots and one of the three that were trained on.
TASKS ?= place_empty_cup beat_block_hammer
TRAINED_ON := aloha_agilex arx_x5 ur5_wsg
ROLLED_OUT ?= ur5_wsg franka_panda piper
DATA := $(DEMO)/data
RUN := $(DEMO)/runs/debug
ROLLOUTS := $(DEMO)/rollouts

demo: $(STAMP)
	$(BIN)/python -m xew.sim_warp.generate --tasks $(TASKS) --robots $(TRAINED_ON) --train-seeds 3 --test-seeds 0 --out $(DATA)
	$(BIN)/python -m xew.sim_warp.generate --tasks $(TASKS) --robots $(ROLLED_OUT) --train-seeds 0 --test-seeds 3 --out $(DATA)
	$(BIN)/python -m xew.model.latents configs/debug.yaml --data $(DATA)
	$(BIN)/python -m xew.model.train configs/debug.yaml --data $(DATA) --out $(RUN) --resume
	$(BIN)/python -m xew.model.rollout $(RUN) --data $(DATA) --split test --robots $(ROLLED_OUT) --out $(ROLLOUTS)
	$(BIN)/python -m xew.metrics.evaluate $(ROLLOUTS) --data $(DATA) --out $(DEMO)/scores.parquet
	$(BIN)/python -m xew.analysis.report $(DEMO)/scores.parquet --data $(DATA) --rollouts $(ROLLOUTS) --out $(DEMO)/report
	@echo "The report is at $(DEMO)/report/index.html"

clean:
	rm -rf $(DEMO) site .pytest_cache .ruff_cache .mypy_cache
