#!/usr/bin/env bash
# Sets everything up in .venv: compiler, packages, kernels, the tracker's networks. A second run is quick.
set -euo pipefail
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python3}
VENV=.venv

say() { printf 'setup: %s\n' "$*" >&2; }
stop() { say "$*"; exit 1; }

# apt-get where we may, else one clear line saying what to install.
need_packages() {
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        say "installing $*"
        { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } >&2 \
            || stop "apt-get could not install: $*"
    else
        stop "please install first: sudo apt-get install $*"
    fi
}

command -v "$PYTHON" >/dev/null || stop "no '$PYTHON' found: install Python 3.11 or newer, or run with PYTHON=/path/to/python"
"$PYTHON" -c 'import sys; raise SystemExit(sys.version_info < (3, 11))' \
    || stop "$("$PYTHON" --version) is too old: Python 3.11 or newer is needed"
version=$("$PYTHON" -c 'import sys; print(f"{sys.version_info.major}.{sys.version_info.minor}")')

# The stamp covers what the set-up reads: unchanged inputs make the next run a no-op.
stamp=$VENV/.set-up-$(cat pyproject.toml constraints.txt CMakeLists.txt scripts/setup.sh \
    mass_engine/tracking/models.py mass_engine/raster/kernels/* mass_engine/deform/kernels/* | sha256sum | cut -c1-16)
if [ -e "$stamp" ] && [ -x "$VENV/bin/mass-engine" ] && "$VENV/bin/python" -c 'import mass_engine.raster._kernels, mass_engine.deform._kernels' 2>/dev/null; then
    "$VENV/bin/python" -m mass_engine.tracking.models >/dev/null && exit 0
fi

"$PYTHON" -c 'import venv, ensurepip' 2>/dev/null || need_packages "python$version-venv"
command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null || need_packages g++
"$PYTHON" -c 'import os, sysconfig; raise SystemExit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))' \
    || need_packages "python$version-dev"
# The tests bring up a real server; everything else does without it.
if ! command -v initdb >/dev/null && ! ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        need_packages postgresql
    else
        say "for the tests, please install PostgreSQL: sudo apt-get install postgresql"
    fi
fi

[ -x "$VENV/bin/python" ] || "$PYTHON" -m venv "$VENV"
export PIP_CONSTRAINT="$PWD/constraints.txt" PIP_DISABLE_PIP_VERSION_CHECK=1
pip() { "$VENV/bin/python" -m pip --quiet "$@" 2> >(grep -v 'is ignored: it is neither a file nor a directory' >&2 || true); }

say "installing packages (several minutes the first time)"
pip install scikit-build-core nanobind cmake ninja torch
say "building the kernels and installing the project"
pip install --no-build-isolation -e '.[dev]'
say "fetching the tracker's networks"
"$VENV/bin/python" -m mass_engine.tracking.models >&2
rm -f "$VENV"/.set-up-*
touch "$stamp"
say "done"
