# make demo | test | serve | bench | install: each makes the virtual environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DDAKF_DATA ?= ../shared/data
export DDAKF_DATA
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help install demo test test-all test-without-recordings coverage mutants warm lint serve bench load soak chaos kill fuzz evaluate report report-quick clean

help:
	@echo "make demo    track the bundled sample through the service; pictures in out/demo (KEEP=1 leaves it running)"
	@echo "make test    lint and the tests that matter most, in at most five minutes on two cores (ARGS='tests/stages -x')"
	@echo "make test-all  lint and all tests, with line coverage, in at most twelve minutes on two cores"
	@echo "make test-without-recordings  the tests that depend on the recordings of DDAKF_DATA, without them"
	@echo "make mutants   200 changes of the stages, one at a time: how many do the tests notice? (ARGS='--mutants 50 ...')"
	@echo "make serve   the service in the foreground"
	@echo "make bench   speed and accuracy, as ratios inside one run"
	@echo "make load    four clients at 30 frames per second: what the service sustains (ARGS='--clients 8 --codec raw ...')"
	@echo "make soak    ten minutes of clients that come and leave: memory, descriptors (ARGS='--seconds 60 ...')"
	@echo "make chaos   kills, cuts, stalls, a full disk, a stopped database; is every session as before? (ARGS='--seed 2 ...')"
	@echo "make kill    how long a session stands still when its worker is killed (ARGS='--vertices 2500 ...')"
	@echo "make fuzz    100,000 damaged inputs to everything that reads bytes, and schemathesis (ARGS='--inputs 10000 ...')"
	@echo "make evaluate  every system of the paper on every sequence, into results/ (hours; goes on where it was; ARGS='--runs 1')"
	@echo "make report    the paper's tables and figures from results/, into out/report"
	@echo "make report-quick  both, small: 2 sequences, 2 views, 2 seeds, 30 frames, into out/quick"
	@echo "make install the development environment in $(VENV)"

# what runs the product, and on top of it what tests it
SERVICE := $(VENV)/.service
DEV := $(VENV)/.dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "ddakf needs Python 3.11 or newer; make PYTHON=/path/to/python3 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { echo "the venv module is missing: on Debian, apt install python3-venv"; exit 2; }

$(SERVICE): pyproject.toml protos/pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV) ..."
	@$(PIP) install --quiet -e protos -e clients/python -e '.[service]'
	@touch $@

$(DEV): $(SERVICE)
	@echo "installing what the tests need ..."
	@$(PIP) install --quiet -e protos -e clients/python -e '.[service,dev]'
	@touch $@

install: $(DEV)

demo: $(SERVICE)
	@$(BIN)/ddakf demo $(if $(KEEP),--keep)

serve: $(SERVICE)
	@$(BIN)/ddakf serve

lint: $(DEV)
	@$(BIN)/ruff check .
	@$(BIN)/lint-imports --no-logo 2>/dev/null || $(BIN)/lint-imports

# a file's tests stay in one process, which keeps the servers they share
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations 15

warm: $(DEV)
	@$(BIN)/ddakf doctor --warm

test: lint warm
	@$(PYTEST) -m "not slow" $(ARGS)

test-all: lint warm
	@$(PYTEST) --cov --cov-report= $(ARGS)
	@$(MAKE) --no-print-directory coverage

test-without-recordings: warm
	@DDAKF_DATA=/nonexistent $(PYTEST) -m recordings $(ARGS)

# line coverage of the last `make test-all`: modules that are not covered in full, and the sum of each package
coverage: $(DEV)
	@$(BIN)/coverage report --skip-covered --sort cover
	@for package in ddakf service/ddakf_service clients/python/ddakf_client protos/ddakf_api; do \
		printf '%-28s %s %%\n' $$package $$($(BIN)/coverage report --format total --include "$$package/*"); \
	done

mutants: warm
	@$(BIN)/python benchmarks/mutants.py $(ARGS)

bench: $(DEV)
	@$(BIN)/python benchmarks/bench.py

load: $(DEV)
	@$(BIN)/python benchmarks/load.py $(ARGS)

soak: $(DEV)
	@$(BIN)/python benchmarks/soak.py $(ARGS)

chaos: $(DEV)
	@$(BIN)/python benchmarks/chaos.py $(ARGS)

kill: $(DEV)
	@$(BIN)/python benchmarks/kill.py $(ARGS)

fuzz: $(DEV)
	@$(PIP) install --quiet -e '.[fuzz]' || echo "atheris cannot be installed here: hypothesis alone"
	@$(BIN)/python benchmarks/fuzz.py $(ARGS)

evaluate: $(DEV)
	@$(BIN)/ddakf evaluate --paper --results results $(ARGS)

report: $(DEV)
	@$(BIN)/ddakf report --results results --out out/report

report-quick: $(DEV)
	@$(BIN)/ddakf evaluate --paper --quick --results out/quick/results $(ARGS)
	@$(BIN)/ddakf report --results out/quick/results --out out/quick

clean:
	@rm -rf $(VENV) out build
