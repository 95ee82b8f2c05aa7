#!/usr/bin/env bash
# Builds the GPU kernels into .venv (docs/gpu.md): with the nvcc that CUDACXX names, or else with NVIDIA's compiler from
# PyPI, installed into .venv. Needs neither root nor a GPU; takes some minutes the first time.
set -euo pipefail
cd "$(dirname "$0")/.."
VENV=.venv
# One release of the toolkit. CUDA 13.0 asks for driver 580 or newer.
WHEELS=(nvidia-cuda-nvcc==13.0.88 nvidia-cuda-runtime==13.0.96 nvidia-cuda-crt==13.0.88 nvidia-nvvm==13.0.88 nvidia-cuda-cccl==13.0.85)

say() { printf 'cuda: %s\n' "$*" >&2; }
stop() { say "$*"; exit 1; }

[ -x "$VENV/bin/python" ] || stop "run make setup first"
export PIP_DISABLE_PIP_VERSION_CHECK=1
pip() { "$VENV/bin/python" -m pip --quiet "$@" 2> >(grep -v 'is ignored: it is neither a file nor a directory' >&2 || true); }

if [ -z "${CUDACXX:-}" ]; then
    case "$(uname -sm)" in
        "Linux x86_64" | "Linux aarch64") ;;
        *) stop "NVIDIA's compiler on PyPI is for Linux: install a CUDA toolkit and set CUDACXX to its nvcc" ;;
    esac
    say "installing ${WHEELS[*]}"
    pip install --no-deps "${WHEELS[@]}"
    home=$("$VENV/bin/python" -c 'import pathlib, sysconfig; print(pathlib.Path(sysconfig.get_path("purelib")) / "nvidia" / "cu13")')
    # The names nvcc and CMake look for, which the wheels leave out.
    [ -e "$home/lib64" ] || ln -s lib "$home/lib64"
    [ -e "$home/lib/libcudart.so" ] || ln -s libcudart.so.13 "$home/lib/libcudart.so"
    export CUDACXX=$home/bin/nvcc
fi
"$CUDACXX" --version | tail -2 | head -1 >&2 || stop "$CUDACXX does not run"
say "building the GPU kernels (some minutes the first time)"
pip install --no-build-isolation --no-deps -e . -C cmake.define.MASS_CUDA=ON
"$VENV/bin/python" - <<'PYTHON'
from mass_engine.raster import _cuda_kernels

print("cuda: built;", _cuda_kernels.problem() or "a GPU can be used")
PYTHON
