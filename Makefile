# One target a task; `make help` lists them. Everything installs into its own virtual environment, pinned.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
# Without --no-compile half of an installation's time would go into bytecode that nothing here runs.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
# uv needs a third of pip's time, and both processors. It does not read pip's settings: pip where uv reaches no index.
UV := $(BIN)/python -m uv pip install --quiet --python $(BIN)/python
# First the locked files, each with its hash; a file with another hash stops all. Where a lock has none for this machine
# (Linux on x86-64 and Python 3.11), or no index is reached, the versions of constraints.txt come without hashes.
locked = said=$$($(UV) --require-hashes --only-binary :all: --requirements pylock.$(1).toml 2>&1) || \
	case $$said in *"Hash mismatch"*) echo "$$said" >&2; exit 1;; \
	*) echo "make: by constraints.txt, not by pylock.$(1).toml: $$(echo "$$said" | tail -n 1)";; esac
install = $(UV) --constraint constraints.txt --editable ".[$(1)]" || $(PIP) --editable ".[$(1)]"
TEST_READY := $(VENV)/.ready-test
BENCHMARK_READY := $(VENV)/.ready-benchmark
DOCS_READY := $(VENV)/.ready-docs
BROWSER_READY := $(VENV)/.ready-browser
# Containers often set this: then each of the hundreds of processes that tests start compiles thousands of modules anew.
unexport PYTHONDONTWRITEBYTECODE
# A worker that runs out of tests takes some of the other's: files differ too much in time to be dealt out whole.
IN_PARALLEL := --numprocesses auto --dist worksteal

.PHONY: help venv lint types test test-all stress test-lowest test-newest test-wheel audit lock test-browser benchmark benchmark-full paper docs tables figures notebooks clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

venv: $(TEST_READY) ## virtual environment with everything: agents, benchmark, tests

lint: $(TEST_READY) ## format and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

# mypy reads no import hooks: it checks a copy in which agents and baselines lie where they are imported from.
TYPES := build/types
MYPY := rm -rf $(TYPES) && mkdir -p $(TYPES) && cp -r cz_gym studies examples *.py $(TYPES) && \
	cp -r agents baselines $(TYPES)/cz_gym && cd $(TYPES) && \
	"$(CURDIR)/$(BIN)/mypy" --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache
types: $(TEST_READY) ## strict types
	$(MYPY)

# Types are checked while tests run: a worker waits for the other's compiled code, and the last tests for one processor.
test: lint ## lint, types and the fast tests, in minutes
	($(MYPY)) & $(BIN)/python -m pytest -q -m "not slow" --ignore tests/stress $(IN_PARALLEL); tests=$$?; wait $$! && exit $$tests

test-all: lint ## lint, types and all tests: cold compiles, wheels, damaged files and kills too
	($(MYPY)) & $(BIN)/python -m pytest -q $(IN_PARALLEL); tests=$$?; wait $$! && exit $$tests

stress: $(TEST_READY) ## damaged files and killed runs alone; test-all has them too
	$(BIN)/python -m pytest -q tests/stress

# Old packages warn about the new ones beneath them, which is not this project's to mend: warnings are no errors there.
test-lowest: ## the tests on the lowest versions that pyproject.toml allows
	$(PYTHON) -m venv build/lowest
	build/lowest/bin/python -m pip install --quiet --constraint constraints-lowest.txt torch
	build/lowest/bin/python -m pip install --quiet --constraint constraints-lowest.txt --editable ".[test]"
	build/lowest/bin/python -m pytest -q -W default $(IN_PARALLEL)

# torch comes first and stands: the newest one from PyPI brings gigabytes of CUDA; `make test-newest TORCH=torch` takes it.
TORCH ?= torch==2.13.0
test-newest: ## the tests on the newest versions there are, but for torch
	$(PYTHON) -m venv build/newest
	build/newest/bin/python -m pip install --quiet "$(TORCH)"
	build/newest/bin/python -m pip install --quiet --upgrade --editable ".[test]"
	build/newest/bin/python -m pytest -q $(IN_PARALLEL)

# The tests come from the source distribution, all code from the wheel built of it.
test-wheel: $(TEST_READY) ## the tests on what the wheel installs, outside this folder
	folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && mkdir "$$folder/tests" && \
	$(BIN)/python -m build --no-isolation --outdir "$$folder" . >/dev/null && \
	tar -xzf "$$folder"/*.tar.gz -C "$$folder/tests" --strip-components=1 && \
	$(BIN)/python -m pip install --quiet --no-deps --target "$$folder/installed" "$$folder"/*.whl && \
	cd "$$folder/tests" && rm -r cz_gym cz_gym_command.py agents baselines && \
	ln -s ../installed/cz_gym ../installed/cz_gym_command.py . && \
	"$(CURDIR)/$(BIN)/python" -m pytest -q $(TESTS) $(IN_PARALLEL)

ADVISORIES := https://pypi.org/pypi/numpy/$(shell sed -n 's/^numpy==//p' constraints.txt)/json
audit: ## known weaknesses of the pinned and of the lowest packages; asks PyPI's advisories
	@$(PYTHON) -c 'import json, urllib.request as web; json.load(web.urlopen("$(ADVISORIES)"))["vulnerabilities"]' \
	2>/dev/null || { echo "audit: nothing was audited: PyPI's advisories cannot be read ($(ADVISORIES))" >&2; exit 2; }
	$(PYTHON) -m venv build/audit
	build/audit/bin/python -m pip install --quiet pip-audit
	for pins in constraints.txt constraints-lowest.txt; do \
	build/audit/bin/pip-audit --requirement $$pins --no-deps --disable-pip --strict || exit 1; done

# torch and what it alone needs stay out: pip's settings say which build of it to take.
lock: $(TEST_READY) ## pylock.*.toml: the pinned versions for Linux with their hashes; asks PyPI
	for extra in benchmark docs test; do echo torch | $(BIN)/uv pip compile pyproject.toml --extra $$extra \
	--constraint constraints.txt --excludes - --python-platform linux --quiet --generate-hashes --no-header \
	--format pylock.toml --output-file pylock.$$extra.toml || exit 1; done

test-browser: $(BROWSER_READY) ## report.html in Chromium without a window; skipped where chromium or chromedriver is absent
	$(BIN)/python -m pytest -q tests/browser

benchmark: $(BENCHMARK_READY) ## shipped agents and classical controllers on the first 100 test crystals, into runs/benchmark
	$(BIN)/python benchmark.py --episodes 100 --out runs/benchmark --overwrite

benchmark-full: $(BENCHMARK_READY) ## the same on all 500: the committed results, in results/benchmark
	$(BIN)/python benchmark.py --overwrite

paper: $(BENCHMARK_READY) ## the paper's numbers beside ours
	$(BIN)/python -m studies.paper

docs: $(DOCS_READY) ## the documentation site, into build/docs; warnings are errors
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -c docs . build/docs

tables: $(DOCS_READY) ## the tables that pages take from the code, into the pages
	PYTHONPATH=docs $(BIN)/python -m czdocs.tables

figures: $(TEST_READY) ## the pictures of the pages, into docs/_static
	PYTHONPATH=docs $(BIN)/python -m czdocs.figures

notebooks: $(DOCS_READY) ## the example pages as Jupyter notebooks, into build/notebooks
	$(BIN)/python docs/notebooks.py build/notebooks

clean: ## remove what builds and checks leave behind; the virtual environment stays
	rm -rf build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(PIP) uv

$(BENCHMARK_READY) $(DOCS_READY): $(VENV)/.ready-%: pyproject.toml constraints.txt pylock.%.toml | $(BIN)/python
	$(call locked,$*)
	$(call install,$*)
	touch $@

# torch by pip, before uv would take another build.
$(TEST_READY): pyproject.toml constraints.txt pylock.test.toml | $(BIN)/python
	$(call locked,test)
	$(PIP) torch
	$(call install,test)
	touch $(BENCHMARK_READY) $(DOCS_READY) $@

$(BROWSER_READY): $(TEST_READY)
	$(call install,browser)
	touch $@
