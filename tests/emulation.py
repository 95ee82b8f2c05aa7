"""GPU kernels on the CPU: the same sources compiled by g++ against an emulated device.

``device.hpp`` is CUDA under nvcc and ``emulator.hpp`` under g++: a block at a time, a fiber per thread. The
module has the interface of the one for the GPU and takes tensors on the CPU.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import nanobind

ROOT = Path(__file__).parent.parent
_FLAGS = ("-std=c++17", "-O1", "-fPIC", "-ffp-contract=off", "-fvisibility=hidden", "-DMASS_EMULATED")
# longjmp between fibers looks like an overrun stack to the fortified library.
_OURS = ("-Wall", "-Wextra", "-Werror", "-U_FORTIFY_SOURCE")


def _compiler() -> str:
    for name in (os.environ.get("CXX"), "g++", "c++", "clang++"):
        if name and shutil.which(name):
            return name
    raise RuntimeError("no C++ compiler: run `make setup`")


def _objects(sources: list[Path], flags: list[str], folder: Path) -> list[Path]:
    """Compile what is not in ``folder`` yet, as many at a time as there are cores."""

    def compile_one(source: Path) -> Path:
        made = folder / f"{source.stem}.o"
        if not made.exists():
            part = made.with_suffix(f".{os.getpid()}.o")
            command = [_compiler(), *flags, "-x", "c++", "-c", str(source), "-o", str(part)]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode != 0:
                raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")
            part.rename(made)
        return made

    with ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2) as pool:
        return list(pool.map(compile_one, sources))


def build(name: str, sources: list[Path], includes: list[Path]) -> ModuleType:
    """The module ``name`` of .cu and .cpp ``sources``; compiled once per change of any file in ``includes``.

    Raises ``RuntimeError`` with the compiler's words when it cannot be built.
    """
    bind = Path(nanobind.include_dir())
    headers = [*includes, bind, *bind.parent.glob("ext/robin_map/include")]
    flags = [*_FLAGS, *(f"-I{path}" for path in (*headers, sysconfig.get_path("include")))]
    digest = hashlib.sha256("\0".join([_compiler(), nanobind.__version__, *flags, *_OURS]).encode())
    shared = ROOT / "build" / "emulated" / digest.hexdigest()[:16]
    for path in sorted(p for folder in includes for p in folder.iterdir() if p.is_file()):
        digest.update(path.name.encode() + path.read_bytes())
    folder = ROOT / "build" / "emulated" / digest.hexdigest()[:16]
    library = folder / name / f"{name}.so"
    if not library.exists():
        for each in (shared, library.parent):
            each.mkdir(parents=True, exist_ok=True)
        objects = _objects(sources, [*flags, *_OURS], folder)
        objects += _objects([bind.parent / "src" / "nb_combined.cpp"], [*flags, "-DNDEBUG"], shared)
        part = library.with_suffix(f".{os.getpid()}.so")
        subprocess.run([_compiler(), "-shared", *map(str, objects), "-o", str(part)], check=True)
        part.rename(library)
    spec = importlib.util.spec_from_file_location(name, library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
