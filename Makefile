# One environment: `make demo` installs what Levkas needs to run, everything else what its development needs too.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
USABLE := $(VENV)/usable
export PYTHONUTF8 := 1
unexport PYTHONDONTWRITEBYTECODE  # a hundred processes of the tests would each compile all sources

# Test processes: one more than two processors, for many wait for a browser, a worker or the disk. Three need about
# 6 GB of memory; on a larger machine: make test WORKERS=8
WORKERS ?= 3
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -rfEs

.PHONY: env demo test test-slow exhaustive mutants warm coverage test-all lint format hooks bench docs reference lock frontend peers compare clean

env: $(READY)
	@echo "The environment is $(VENV). Next: make demo | test | lint | docs; CONTRIBUTING.md says more."

demo: $(USABLE)
	$(BIN)/levkas demo demo

# The tests to run before every commit; what was skipped, and why, stands at the end. `make test SLOW=1`: the slow ones too;
# `make test TURN=2/5`: of those the third of five parts.
test: pages
	$(if $(TURN),LEVKAS_SLOW_TURN=$(TURN) )$(PYTEST) $(if $(SLOW)$(TURN),--durations=25,-m "not slow")

# What takes more than three seconds: whole builds, faults at every step, same bytes on any number of threads, long browser walks.
test-slow: pages
	$(PYTEST) -m slow --durations=25

# What the tests take a few of: tests marked `exhaustive`, faults at every step, every change of a campaign, every hostile file through the
# commands, bytes under every circumstance, examples drawn anew. Hours.
exhaustive: $(READY)
	$(PYTEST) -m hypothesis --hypothesis-profile=explore
	LEVKAS_EVERY_CASE=1 $(PYTEST) -m exhaustive
	LEVKAS_EVERY_CASE=1 $(PYTEST) tests/building/test_faults.py tests/building/test_staleness.py \
		tests/building/test_same_bytes.py tests/cli/test_hostile_commands.py

# Whether the tests find faults that are planted in a copy of the package, one at a time: an hour.
mutants: $(READY)
	$(BIN)/python benchmarks/mutants.py

# Which lines and branches of the package the fast tests run.
coverage: pages
	$(PYTEST) -m "not slow" --cov=levkas --cov-branch --cov-report=term

test-all:
	$(MAKE) test SLOW=1

# Compiles once, while something else runs, what every process of the tests would compile for itself where nothing is kept
# yet: the tests' sources and the kernels of a build.
warm: pages
	-@$(BIN)/python -m pytest --collect-only -qq >/dev/null
	-@$(BIN)/python -m pytest -qq tests/building/test_world.py -k strips >/dev/null

# Brings the pages up to date; the browser tests are skipped where that cannot be done here.
.PHONY: pages
pages: $(READY)
	-@$(BIN)/python hatch_build.py

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python hatch_build.py lint

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Runs the quick part of `make lint` before every commit.
hooks: $(READY)
	$(BIN)/pre-commit install

# Every benchmark; each prints its own table. Hours: the full-size build simulates 2.4 GB first.
bench: $(READY)
	for script in $(filter-out %/results.py %/unchanged.py %/mutants.py %/methods.py,$(wildcard benchmarks/*.py)); do \
		echo "== $$script"; $(BIN)/python $$script || exit 1; done

docs: $(READY)
	rm -rf docs/_generated
	$(BIN)/python -m sphinx -W -b html docs docs/_build/html

# What runs, and no more; an environment for development has it too. uv installs the same pinned, hashed packages
# several times faster where it is to be had.
$(USABLE): requirements-use.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("levkas needs Python 3.11 or newer, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	@if test ! -e $(READY); then \
		printf 'Installing Levkas and what it needs (0.8 GB on the disk) into $(VENV), once ... '; \
		test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || exit 1; \
		if command -v uv >/dev/null 2>&1; then \
			uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements-use.lock || exit 1; \
		else \
			$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements-use.lock || exit 1; \
		fi; \
		$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null || exit 1; \
		$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps . || exit 1; \
		echo done; \
	fi
	@touch $(USABLE)

$(READY): requirements.lock pyproject.toml hatch_build.py
	$(PYTHON) -c 'import sys; sys.exit("levkas needs Python 3.11 or newer, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	if command -v uv >/dev/null 2>&1; then \
		uv pip install --python $(BIN)/python --require-hashes -r requirements.lock; \
	else \
		$(BIN)/python -m pip install --disable-pip-version-check --no-compile --require-hashes -r requirements.lock; \
	fi
	$(BIN)/python -m pip install --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $(READY)

# The pages of the viewer and the workbench; an installation builds them too.
frontend: $(READY)
	$(BIN)/python hatch_build.py

reference: $(READY)
	$(BIN)/python docs/write_commands.py
	$(BIN)/python docs/write_benchmarks.py
	$(BIN)/python paper/figures.py

# The programs that benchmarks/methods.py sets beside Levkas, in an environment of their own.
PEERS := $(VENV)-peers
peers: requirements-peers.lock
	test -x $(PEERS)/bin/python || $(PYTHON) -m venv $(PEERS)
	if command -v uv >/dev/null 2>&1; then \
		uv pip install --python $(PEERS)/bin/python --require-hashes -r requirements-peers.lock; \
	else \
		$(PEERS)/bin/python -m pip install --disable-pip-version-check --require-hashes -r requirements-peers.lock; \
	fi

# make compare CAMPAIGN=demo OUT=comparison
CAMPAIGN ?= demo
OUT ?= comparison
compare: peers
	PYTHONPATH=src $(PEERS)/bin/python benchmarks/methods.py $(CAMPAIGN) -o $(OUT)

lock: # first the environment for development, then the same versions of what runs alone
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --extra test --extra lint --extra docs pyproject.toml requirements-build.in -o requirements.lock
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --constraint requirements.lock pyproject.toml -o requirements-use.lock
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --extra peers pyproject.toml -o requirements-peers.lock

clean:
	rm -rf $(VENV) $(PEERS) build dist demo docs/_build .pytest_cache .mypy_cache .ruff_cache
