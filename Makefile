# Two commands matter: `make demo [VIDEO=path.mp4]` and `make test`.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
VIDEO ?=
DEMO_OUT ?= demo-output

.PHONY: help setup demo serve test cuda lint check-types bench openapi clean

help:
	@echo "make demo [VIDEO=path.mp4]  run one job through the service, save renders and assets to $(DEMO_OUT)/"
	@echo "make test                   run all checks and tests"
	@echo "make setup | serve | bench | lint | openapi | cuda | clean"

setup:
	@scripts/setup.sh

demo: setup
	@$(BIN)/python scripts/demo.py $(if $(VIDEO),--video "$(VIDEO)") --out "$(DEMO_OUT)"

serve: setup
	@$(BIN)/mass serve

cuda: setup  # the GPU kernels, by your nvcc (CUDACXX) or one installed into $(VENV)
	@scripts/cuda.sh

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/yamllint -s docker-compose.yml

test: lint
	$(BIN)/python -m pytest

bench: setup
	$(BIN)/mass-engine bench raster
	$(BIN)/mass-engine bench render

openapi: setup  # BREAK=1 for a change that breaks clients
	$(BIN)/python -m service.openapi $(if $(BREAK),--break)

clean:
	rm -rf build dist demo-output .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
