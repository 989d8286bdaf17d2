# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
ARGS ?=
MINUTES ?= 2

# $(call with,EXTRA): set $python to the environment's Python, making the environment first.
with = python=$$(PYTHON='$(PYTHON)' sh scripts/environment.sh $(1))

.PHONY: help demo demo-arm paper tune compare evidence test lint docs bench soak clean
.NOTPARALLEL:

help:
	@echo 'make demo    run plant and estimator for 20 s, draw what was estimated'
	@echo 'make demo-arm  a simulated robot arm is hit, leaned on a wall and pushed; needs MuJoCo'
	@echo 'make paper   reproduce the paper, rewrite docs/evidence and its figures'
	@echo 'make tune    find gains that fit a sensor: ARGS="--params-file my.yaml", or --bag run'
	@echo 'make compare tune other observers by the same rules, rewrite docs/evidence'
	@echo 'make evidence  all tables and figures in docs/evidence but recipes and speed: for a night'
	@echo 'make test    check style and types, run the tests'
	@echo 'make lint    check style and types only'
	@echo 'make docs    build the pages in docs/ as a site, build/docs/index.html'
	@echo 'make bench   measure speed'
	@echo 'make soak    run with faults for MINUTES=2, judge memory, losses and drift'
	@echo 'make clean   remove environments, builds and caches'
	@echo
	@echo "Pass options on with ARGS: make demo ARGS='--help', make test ARGS='-k fuzzy'."
	@echo 'Choose the interpreter with PYTHON: make demo PYTHON=python3.12'

# exec: the command is then make's own child, so Ctrl-C and exit codes pass through no shell.
demo:
	@$(call with) && exec "$$python" -m fhaosmo_ros demo $(ARGS)

demo-arm:
	@$(call with,arm-study) && exec "$$python" -m studies.arm.demo $(ARGS)

paper:
	@$(call with) && exec "$$python" -m studies.paper $(ARGS)

tune:
	@$(call with,tune) && exec "$$python" -m fhaosmo_ros tune $(ARGS)

compare:
	@$(call with,compare) && exec "$$python" -m studies.comparison $(ARGS)

evidence: paper compare
	@$(call with,compare) && "$$python" -m studies.everywhere && "$$python" -m studies.elsewhere && \
	exec "$$python" -m studies.self_tuning

lint:
	@$(call with,test) && set -x && \
	"$$python" -m ruff check --output-format concise . && \
	"$$python" -m ruff format --check . && \
	"$$python" -m mypy && \
	PATH="$${python%/*}:$$PATH" cython-lint fhaosmo_ros studies && \
	"$${python%/*}/lint-imports" --no-logo

test: lint
	@$(call with,test) && exec "$$python" -m pytest -n 2 --dist loadfile $(ARGS)

docs:
	@$(call with,docs) && exec "$$python" -m sphinx -W --keep-going -q $(ARGS) docs build/docs

bench:
	@$(call with,arm) && exec "$$python" benchmark/run.py $(ARGS)

soak:
	@$(call with) && exec "$$python" benchmark/soak.py --minutes $(MINUTES) $(ARGS)

clean:
	rm -rf .venv .venv-ros .venv-kilted build install log *.egg-info .coverage .hypothesis \
	    .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name .git -prune -o -name __pycache__ -type d -exec rm -rf {} +
	find fhaosmo_ros studies \( -name '*.so' -o -name '*.c' \) -exec rm {} +
