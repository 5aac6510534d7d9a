# make demo | test | serve | bench | install: each makes the virtual environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DDAKF_DATA ?= ../shared/data
export DDAKF_DATA
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help install demo test test-all test-without-recordings coverage dashboard test-web mutants warm lint serve bench load soak chaos kill cluster-test fuzz evaluate headline report report-quick clean \
  docs image image-test image-slim image-s3 image-ray image-slim-test image-s3-test image-ray-test compose-test lock dist version sbom audit

help:
	@echo "make demo    track the bundled sample through the service; pictures in out/demo (KEEP=1 leaves it running)"
	@echo "make test    lint and the tests that matter most, in at most five minutes on two cores (ARGS='tests/stages -x')"
	@echo "make test-all  lint and all tests"
	@echo "make test-without-recordings  the tests that depend on the recordings of DDAKF_DATA, without them"
	@echo "make test-web  the TypeScript client and the dashboard: types, lint, tests with a service and in Chromium (needs Node 20.19 and Chromium)"
	@echo "make dashboard  the dashboard's page into $(BUILT), which is committed (needs Node 20.19)"
	@echo "make mutants   200 changes of the stages, one at a time: how many do the tests notice? (ARGS='--mutants 50 ...')"
	@echo "make docs    the documentation site, into out/site"
	@echo "make serve   the service in the foreground"
	@echo "make bench   speed and accuracy, as ratios inside one run"
	@echo "make load    four clients at 30 frames per second: what the service sustains (ARGS='--clients 8 --codec raw ...')"
	@echo "make soak    ten minutes of clients that come and leave: memory, descriptors (ARGS='--seconds 60 ...')"
	@echo "make chaos   a hostile session, kills, cuts, stalls, a full disk, a stopped database; is every session as before? (ARGS='--seed 2 ...')"
	@echo "make kill    how long a session stands still when its worker is killed (ARGS='--vertices 2500 ...')"
	@echo "make cluster-test  two gateways on a Ray cluster and PostgreSQL: an actor, a node, a gateway killed, a node and a gateway drained (ARGS='--worker-kind local ...')"
	@echo "make fuzz    100,000 damaged inputs to everything that reads bytes, schemathesis, adversarial frames (ARGS='--inputs 10000 ...')"
	@echo "make evaluate  every system of the paper on every sequence, into results/ (days on two cores; resumes; ARGS='--runs 1')"
	@echo "make headline  its study of untouched recordings with five seeds, resumed, and its tables and figures (ARGS='--again ddakf')"
	@echo "make report    the paper's tables and figures from results/, into out/report"
	@echo "make report-quick  both, small: 2 sequences, 3 conditions, 2 seeds, 30 frames, into out/quick"
	@echo "make image   the container image, with Docker or Buildah (make image-slim: without Pillow; image-s3, image-ray: with those extras)"
	@echo "make image-test  builds it and tries it: user, read-only root, drain, resume, size, first frame (also image-slim-test, image-s3-test, image-ray-test)"
	@echo "make compose-test  runs compose.yaml with every profile; as root with Debian's docker.io and docker-compose where no engine is"
	@echo "make dist    wheels, source archives and the npm package, into dist (needs Node 20.19)"
	@echo "make lock    renews uv.lock from the ranges of the pyproject.toml files"
	@echo "make version V=0.2.0  the version everywhere it is written"
	@echo "make sbom    bills of materials of the images' packages (CycloneDX), into dist"
	@echo "make audit   known vulnerabilities and licences of the images' packages"
	@echo "make install the development environment in $(VENV) (LOCKED=1: the versions of uv.lock)"

# what runs the product, and on top of it what tests it
SERVICE := $(VENV)/.service
DEV := $(VENV)/.dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "ddakf needs Python 3.11 or newer; make PYTHON=/path/to/python3 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { echo "the venv module is missing: on Debian, apt install python3-venv"; exit 2; }

# the lock as pip's constraints; any pip installs from it, without uv's own environment
LOCK := build/constraints.txt
UV := $(BIN)/uv
ifdef LOCKED
CONSTRAINTS := -c $(LOCK)
LOCK_NEEDED := $(LOCK)
endif

$(UV): docker/uv-version | $(BIN)/python
	@$(PIP) install --quiet "uv==$$(cat docker/uv-version)"
	@touch $@

$(LOCK): uv.lock | $(UV)
	@mkdir -p build
	@$(UV) export --quiet --frozen --all-extras --no-emit-workspace --no-hashes --no-annotate --no-header -o $@

$(SERVICE): pyproject.toml protos/pyproject.toml clients/python/pyproject.toml $(LOCK_NEEDED) | $(BIN)/python
	@echo "installing into $(VENV) ..."
	@$(PIP) install --quiet $(CONSTRAINTS) -e protos -e 'clients/python[recording]' -e '.[service]'
	@touch $@

$(DEV): $(SERVICE)
	@echo "installing what the tests need ..."
	@$(PIP) install --quiet $(CONSTRAINTS) -e protos -e clients/python -e '.[service,dev]'
	@touch $@

install: $(DEV)

demo: $(SERVICE)
	@$(BIN)/ddakf demo $(if $(KEEP),--keep)

serve: $(SERVICE)
	@$(BIN)/ddakf serve

lint: $(DEV)
	@$(BIN)/ruff check .
	@$(BIN)/lint-imports --no-logo 2>/dev/null || $(BIN)/lint-imports

# a file's tests stay in one process, which keeps the servers they share; three processes on two cores, since servers make tests wait
PYTEST := $(BIN)/python -m pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder --durations 15

warm: $(DEV)
	@$(BIN)/ddakf doctor --warm

test: lint warm
	@$(PYTEST) -m "not slow" $(ARGS)

test-all: lint warm
	@$(PYTEST) -rsfE $(ARGS)

test-without-recordings: warm
	@DDAKF_DATA=/nonexistent $(PYTEST) -m recordings $(ARGS)

# line coverage of all tests, which it slows down: modules that are not covered in full, the sum of each package
coverage: warm
	@$(PYTEST) --cov --cov-report= $(ARGS)
	@$(BIN)/coverage combine --append --quiet 2>/dev/null || true
	@rm -f .coverage.*  # of processes killed while they wrote
	@$(BIN)/coverage report --skip-covered --sort cover
	@for package in ddakf service/ddakf_service clients/python/ddakf_client protos/ddakf_api; do \
		printf '%-28s %s %%\n' $$package $$($(BIN)/coverage report --format total --include "$$package/*"); \
	done

WEB := clients/typescript
DASHBOARD := clients/dashboard
BUILT := service/ddakf_service/static/dashboard

%/node_modules/.package-lock.json: %/package-lock.json
	@cd $* && npm ci --no-audit --no-fund

WEB_PACKAGES := $(WEB)/node_modules/.package-lock.json $(DASHBOARD)/node_modules/.package-lock.json

# the dashboard's page, built into the service and committed: an installation of the service needs no Node
dashboard: $(WEB_PACKAGES)
	@cd $(WEB) && npm run --silent build
	@cd $(DASHBOARD) && npx vite build --logLevel warn
	@du -sb $(BUILT)

# everything that needs Node and a browser; `make test` needs neither
test-web: export DDAKF_PYTHON := $(abspath $(BIN))/python
test-web: warm $(WEB_PACKAGES)
	@cd $(WEB) && npm run --silent build && npm run --silent types && npm run --silent lint && npx vitest run $(ARGS)
	@cd $(DASHBOARD) && npm run --silent types && npm run --silent lint
	@cd $(DASHBOARD) && npx vite build --logLevel warn --outDir dist && diff -rq dist ../../$(BUILT) \
		|| { echo "$(BUILT) is not the build of $(DASHBOARD): run 'make dashboard' and commit it"; exit 1; }
	@cd $(DASHBOARD) && npx vitest run $(ARGS)
	@$(BIN)/python -m pytest tests/deployment/test_dist.py -k npm

# the documentation site, with broken links as errors
docs: $(DEV)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "out/site/index.html"

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

cluster-test: $(DEV)
	@$(BIN)/python benchmarks/cluster.py $(ARGS)

fuzz: $(DEV)
	@$(PIP) install --quiet -e '.[fuzz]' || echo "atheris cannot be installed here: hypothesis alone"
	@$(BIN)/python benchmarks/fuzz.py $(ARGS)

evaluate: $(DEV)
	@$(BIN)/ddakf evaluate --paper --results results $(ARGS)

# the untouched study, without what takes longer than a frame
SYSTEMS := still,carried,kf,icp,pf,opt-ed,nicp,printed,ddakf
headline: $(DEV)
	@$(BIN)/ddakf evaluate --paper --only untouched --runs 5 --no-surfaces --methods $(SYSTEMS) --results results $(ARGS)
	@$(BIN)/ddakf report --results results --out out/report --markdown docs/results.md docs/results/untouched.md \
	  docs/results/paper.md docs/results/depth.md
	@cp out/report/speed.png out/report/calibration.png docs

report: $(DEV)
	@$(BIN)/ddakf report --results results --out out/report

report-quick: $(DEV)
	@$(BIN)/ddakf evaluate --paper --quick --results out/quick/results $(ARGS)
	@$(BIN)/ddakf report --results out/quick/results --out out/quick

image:
	@docker/build full

image-slim:
	@docker/build slim

image-s3:
	@docker/build s3

image-ray:
	@docker/build ray

image-test: image $(DEV)
	@DDAKF_IMAGE=ddakf:latest $(BIN)/python -m pytest tests/deployment/test_image.py -s $(ARGS)

image-slim-test image-s3-test image-ray-test: image-%-test: image-% $(DEV)
	@DDAKF_IMAGE=ddakf:$* $(BIN)/python -m pytest tests/deployment/test_image.py -s $(ARGS)

# with an engine of its own in namespaces where none answers
compose-test: image image-ray $(DEV)
	@docker info >/dev/null 2>&1 || engine=tests/deployment/engine/run; \
	  DDAKF_COMPOSE=1 $$engine $(BIN)/python -m pytest tests/deployment/test_compose.py -s $(ARGS)

lock: $(UV)
	@$(UV) lock --quiet

dist: $(UV) $(WEB)/node_modules/.package-lock.json
	@rm -rf dist && mkdir dist
	@$(UV) build --quiet --all-packages --out-dir dist
	@cd $(WEB) && npm run --silent build && npm pack --silent --pack-destination ../../dist
	@ls -l dist

version: $(DEV)
	@$(BIN)/python release/version.py $(V)

# what the images install, as docker/build names them; of ddakf:slim it is the same without Pillow
IMAGE := --frozen --extra service --extra postgres --extra tracing
IMAGE_S3 := $(IMAGE) --extra s3
IMAGE_RAY := $(IMAGE_S3) --extra ray

sbom: $(UV)
	@mkdir -p dist
	@$(UV) export --quiet $(IMAGE) --format cyclonedx1.5 -o dist/ddakf.cdx.json >/dev/null
	@$(UV) export --quiet $(IMAGE_S3) --format cyclonedx1.5 -o dist/ddakf-s3.cdx.json >/dev/null
	@$(UV) export --quiet $(IMAGE_RAY) --format cyclonedx1.5 -o dist/ddakf-ray.cdx.json >/dev/null
	@ls dist/*.cdx.json

audit: $(UV) $(DEV) $(LOCK)
	@$(PIP) install --quiet -c $(LOCK) s3fs
	@$(BIN)/python release/licences.py
	@$(UV) export --quiet $(IMAGE_RAY) --no-emit-workspace --no-header -o build/audited.txt
	@$(UV) tool run --quiet pip-audit --strict --disable-pip --require-hashes -r build/audited.txt

clean:
	@rm -rf $(VENV) out build dist
