# make run     environment, generated sample, the whole pipeline to a report
# make test    the tests, but for the long ones and most examples, which `make test-thorough` has
# make test-lowest  the core's tests with the lowest versions that pyproject.toml admits
# make lint    ruff, types, import rules
# make bench   what is claimed about speed and memory
# make onboard-study   what an on-board view costs: docs/onboard-view.md (a quarter of an hour)
# make study   models on recorded and generated traffic, with intervals: docs/results.md (hours; pieces: --plan)
# make docs    pages derived from the code
# make clean   removes the environment and caches, never data
#
# `make run ARGS="--minutes 0.3 --lake /tmp/lake"` passes options on.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/.installed
ARGS ?=

.PHONY: install run test test-thorough test-lowest lint bench study onboard-study docs clean

install: $(INSTALLED)

# torch first and by its exact version: as a dependency of something else, pip may take a build with all of CUDA.
$(INSTALLED): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14) and "Python 3.11 to 3.13 is needed: make PYTHON=...")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --editable ".[all,dev]"
	touch $@

run: install
	$(BIN)/tracklake run $(ARGS)

# Bytecode is kept, whatever the environment says: tests start many commands.
test: install
	PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -n 2 --dist loadgroup $(ARGS)

test-thorough: install
	PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -n 2 --dist loadgroup --thorough $(ARGS)

# The tests in which versions matter most: files, SQL, validation, charts, the whole pipeline (in the fixture `lake`).
# Without torch, whose lowest version comes with 5 GB of CUDA: it was tried by hand, see pyproject.toml.
LOWEST := .venv-lowest
CORE := tests/test_extras.py tests/schemas tests/quality_reports/rules tests/pipeline/transforms/starts \
	tests/pipeline/sources/csv/test_table_files.py tests/pipeline/lake/test_macros.py tests/pipeline/cli/test_sql_command.py \
	tests/pipeline/export tests/training/lane_changes/test_lane_forest.py \
	tests/pipeline/orchestration/test_dask_workers.py

test-lowest: install
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(LOWEST)
	$(BIN)/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct \
		--editable ".[flows,report,forest,matlab,reconstruct,sample,distributed,dev]"
	$(LOWEST)/bin/pytest -n 2 --dist loadgroup $(CORE)

# mypy and import-linter read folders, not what an import finds: links give the packages their installed names.
lint: install
	@mkdir -p .lint/tracklake
	@for each in pipeline schemas quality_reports training; do ln -sfn ../../$$each .lint/tracklake/$$each; done
	@for each in __init__.py py.typed; do ln -sfn ../../src/tracklake/$$each .lint/tracklake/$$each; done
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=.lint $(BIN)/lint-imports

bench: install
	@for file in $(filter-out $(wildcard benchmarks/study*.py),$(wildcard benchmarks/*.py)); do echo "== $$file"; $(BIN)/python $$file $(ARGS) || exit 1; done

study: install
	PYTHONPATH=benchmarks $(BIN)/python -m study $(ARGS)

onboard-study: install
	$(BIN)/python benchmarks/study_onboard.py $(ARGS)

docs: install
	$(BIN)/python -m tracklake.schemas.markdown > docs/tables.md
	$(BIN)/python -m tracklake.schemas.tensors_markdown > docs/tensors.md
	$(BIN)/python -m tracklake.schemas.protocols_markdown > docs/protocols.md
	$(BIN)/python -m tracklake.schemas.references_markdown > docs/references.md
	$(BIN)/python -m tracklake.schemas.quality_markdown > docs/quality_json.md
	$(BIN)/python -m tracklake.training.models.markdown > docs/models.md
	$(BIN)/python -m tracklake.quality_reports.rules.markdown > docs/rules.md
	$(BIN)/python -m tracklake.quality_reports.gates.markdown > docs/check.md

clean:
	rm -rf .venv .venv-lowest .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
