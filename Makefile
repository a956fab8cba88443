# make demo    install everything into .venv, run the nodes, write pictures to demo/
# make test    the tests, as CI runs them
# make lint    format, lint and types
# make check   lint, and the quick tests: all but those that need ROS, start processes or are slow
# make test-all  the tests and the nightly ones: browser, cluster, hosts, packages, fuzzers, benchmarks, tools
# make tf2_msgs   build the messages of /tf, which are not on PyPI, into .venv; so do make simulation_interfaces, vision_msgs,
#                 people_msgs, spencer_tracking_msgs and hri_msgs
# make bench   every benchmark, one after the other
# make docs    the documentation as a site in site/
# make dist    wheel and sdist in dist/, checked, installed and run in fresh environments (docs/releasing.md)
# make clean   remove what these have made
VENV ?= .venv
BIN := $(VENV)/bin
export VENV
# Without compiled modules, each test process takes half a second longer to import the package.
export PYTHONDONTWRITEBYTECODE :=

# A sourced ROS would put its own Python packages and libraries in front of those in the environment.
ifdef ROS_DISTRO
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH
endif

# Tests and benchmarks start many processes: each of them would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo check test test-all lint bench docs dist tf2_msgs simulation_interfaces vision_msgs people_msgs \
	spencer_tracking_msgs hri_msgs clean env env-test env-bench env-docs

demo: env
	$(BIN)/humansim demo

check: lint
	$(BIN)/python -m pytest -n auto -m "not ros and not process and not slow and not nightly"

# Tests of nodes and processes share the machine's network and clock: three files at a time, each in a ROS
# domain of its own, because a third of their time is waiting. Tests that only build messages run with all
# others; examples in docstrings, too, so that the second part does not look for them. Failures of the first
# part do not hide those of the second.
test: TIER = and not nightly
test test-all: env-test
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not ros and not process $(TIER)"; first=$$?; \
	$(BIN)/python -m pytest -n 3 --dist loadfile -m "(ros or process) $(TIER)" test && exit $$first

lint: env-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: env-bench
	@set -e; for file in benchmarks/*.py; do echo "== $$file"; $(BIN)/python "$$file"; done

docs: env-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "Look at it: $(BIN)/python -m http.server --bind 127.0.0.1 --directory site 8000, then http://127.0.0.1:8000"

tf2_msgs simulation_interfaces vision_msgs people_msgs spencer_tracking_msgs hri_msgs: env
	$(BIN)/python tools/build_interfaces.py $@ --install

dist:
	@tools/check_dist.sh

# all that commands and code of the README, the first ten minutes and the tutorials use
env:
	@tools/setup_env.sh ros,view,export,photographs,plot,pytest

env-test:
	@tools/setup_env.sh ros,view,test

env-bench:
	@tools/setup_env.sh ros,bench

env-docs:
	@tools/setup_env.sh ros,docs

clean:
	rm -rf $(VENV) build install log dist site demo .nox *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
