#!/usr/bin/env bash
# The border of the core, shown without a linter: its tests run on a copy of the package from which everything beyond the
# border was left out, where nothing but the core's dependencies is installed. Options go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
copy=build/core
rm -rf "$copy/src" "$copy/tests" "$copy/docs"
mkdir -p "$copy/src/skyloop" "$copy/tests" "$copy/scripts"
cp src/skyloop/*.py src/skyloop/*.pyi src/skyloop/py.typed "$copy/src/skyloop"
rm "$copy/src/skyloop/"{bench,ray}.py
cp -r src/skyloop/{messages,transport,proxy,client,aio,drivers} "$copy/src/skyloop"
cp pyproject.toml README.md LICENSE "$copy"
cp tests/{__init__,conftest}.py "$copy/tests"
cp -r tests/{messages,transport,proxy,client,support,data} "$copy/tests"
cp -r docs "$copy"
cp scripts/aio_stub.py "$copy/scripts"
# Tests of what plugs into the core, and those that need SciPy, PyAV or what stands beside the package.
rm "$copy"/tests/{transport/test_overload,messages/test_geometry}.py
rm "$copy"/tests/client/test_{connect,end_of_flight,preflight}.py
rm "$copy"/tests/proxy/test_{safety,h264_encoder,stream_rate}.py
if ! [[ -e $copy/venv/installed && $copy/venv/installed -nt pyproject.toml ]]; then
  "${PYTHON:-python3}" -m venv "$copy/venv"
  "$copy/venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$copy" \
    pytest pytest-cov pytest-timeout pytest-xdist hypothesis
  touch "$copy/venv/installed"
fi
cd "$copy"
venv/bin/python -m pytest -m 'not process' "$@" && exit
echo "UNSTABLE OR BROKEN, run again one by one:" # a machine that was held up fails no test then, what is broken does
venv/bin/python -m pytest -m 'not process' "$@" --numprocesses 0 --cov-append --last-failed --last-failed-no-failures none
