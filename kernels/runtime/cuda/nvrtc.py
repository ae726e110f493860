"""Compiling CUDA C++ at run time through NVRTC, the library that torch's wheels bring along;
results are cached.

``torch.cuda._compile_kernel`` does a similar thing, but keeps nothing on disk, compiles a source
again for each of its kernels, needs setuptools, and has no header files and no 64-bit arguments.
"""

import ctypes
import functools
import hashlib
import importlib.util
import logging
import sys
from pathlib import Path

import torch

from gsfusion_nb.backends import BackendUnavailable
from gsfusion_nb.files import cache_folder, write_file
from gsfusion_nb.render import constants

log = logging.getLogger(__name__)

KERNELS = Path(__file__).parents[2]

_NUMBERS = (
    "SCREEN_BLUR_PX2",
    "ALPHA_MAX",
    "ALPHA_MIN",
    "TRANSMITTANCE_MIN",
    "FARTHEST_PX",
)

OPTIONS = (
    "-std=c++17",
    # A multiplication and an addition become one operation only where the source says fmaf:
    # counting and listing, and forward and backward, have to round alike.
    "--fmad=false",
    *(f"-DGS_{name}={getattr(constants, name):.9g}f" for name in _NUMBERS),
)
"""For every compiler: NVRTC here, nvcc and g++ in the tests."""


def compile_source(stem: str, capability: tuple[int, int]) -> bytes:
    """Machine code of ``<stem>.cu`` for a GPU of that compute capability (PTX if it is newer than
    the compiler).

    Raises:
        BackendUnavailable: the source does not compile; the compiler's words are in the message.
        BackendUnavailable: there is no NVRTC.
    """
    nvrtc = library()
    source = (KERNELS / stem / f"{stem}.cu").read_text(encoding="utf-8")
    headers = {
        path.name: path.read_text(encoding="utf-8") for path in sorted(KERNELS.glob("*/*.cuh"))
    }
    options = (f"--gpu-architecture={_architecture(nvrtc, capability)}", *OPTIONS)
    text = "\0".join([source, *headers.values(), *options, str(_version(nvrtc))])
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    cache_file = cache_folder() / "cuda" / f"{stem}-{options[0].split('=')[1]}-{key}.cubin"
    if cache_file.exists():
        return cache_file.read_bytes()
    image = _compile(nvrtc, f"{stem}.cu", source, headers, options)
    try:
        write_file(cache_file, image)
    except OSError as e:
        log.info("compiled kernels are not kept: %s", e)
    return image


@functools.cache
def library() -> ctypes.CDLL:
    """NVRTC, of the CUDA version that torch was built with where that can be had.

    Raises:
        BackendUnavailable: it cannot be found.
    """
    major = (torch.version.cuda or "13").split(".")[0]
    name = f"nvrtc64_{major}0_0.dll" if sys.platform == "win32" else f"libnvrtc.so.{major}"
    for candidate in (name, *_in_wheels(name)):
        try:
            return ctypes.CDLL(candidate)
        except OSError:
            continue
    raise BackendUnavailable(
        f"backend 'cuda' needs NVRTC ({name}), which is neither in torch's packages nor in the "
        "system; "
        f"'pip install nvidia-cuda-nvrtc{'' if int(major) > 12 else '-cu' + major}' brings it"
    )


def _in_wheels(name: str) -> list[str]:
    """Where torch's dependencies from PyPI may have put a library."""
    folders = [Path(torch.__file__).parent / "lib"]
    spec = importlib.util.find_spec("nvidia")
    for root in spec.submodule_search_locations or () if spec else ():
        folders += [folder for part in ("lib", "bin") for folder in Path(root).glob(f"*/{part}")]
    return [str(folder / name) for folder in folders if (folder / name).exists()]


def _compile(
    nvrtc: ctypes.CDLL,
    name: str,
    source: str,
    headers: dict[str, str],
    options: tuple[str, ...],
) -> bytes:
    program = ctypes.c_void_p()
    texts = (ctypes.c_char_p * len(headers))(*(text.encode() for text in headers.values()))
    names = (ctypes.c_char_p * len(headers))(*(header.encode() for header in headers))
    made = nvrtc.nvrtcCreateProgram(
        ctypes.byref(program), source.encode(), name.encode(), len(headers), texts, names
    )
    _check(nvrtc, name, made)
    try:
        flags = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if nvrtc.nvrtcCompileProgram(program, len(options), flags):
            log = _fetch(nvrtc, name, program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            raise BackendUnavailable(f"{name} does not compile with {' '.join(options)}:\n{log}")
        kind = "CUBIN" if "=sm_" in options[0] else "PTX"
        return _fetch(nvrtc, name, program, kind)
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _fetch(
    nvrtc: ctypes.CDLL,
    name: str,
    program: ctypes.c_void_p,
    kind: str,
) -> bytes:
    size = ctypes.c_size_t()
    _check(nvrtc, name, getattr(nvrtc, f"nvrtcGet{kind}Size")(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check(nvrtc, name, getattr(nvrtc, f"nvrtcGet{kind}")(program, buffer))
    return buffer.raw


def _architecture(nvrtc: ctypes.CDLL, capability: tuple[int, int]) -> str:
    own = 10 * capability[0] + capability[1]
    count = ctypes.c_int()
    _check(nvrtc, "NVRTC", nvrtc.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
    supported_list = (ctypes.c_int * count.value)()
    _check(nvrtc, "NVRTC", nvrtc.nvrtcGetSupportedArchs(supported_list))
    if own in supported_list:
        return f"sm_{own}"
    older = [arch for arch in supported_list if arch < own]
    if not older:
        raise BackendUnavailable(
            f"backend 'cuda' needs a GPU of compute capability {min(supported_list) / 10:.1f} or "
            f"more, got {own / 10:.1f}"
        )
    return f"compute_{max(older)}"


def _version(nvrtc: ctypes.CDLL) -> tuple[int, int]:
    major = ctypes.c_int()
    minor = ctypes.c_int()
    _check(nvrtc, "NVRTC", nvrtc.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
    return major.value, minor.value


def _check(nvrtc: ctypes.CDLL, name: str, status: int) -> None:
    if status:
        nvrtc.nvrtcGetErrorString.restype = ctypes.c_char_p
        raise RuntimeError(f"{name}: NVRTC says {nvrtc.nvrtcGetErrorString(status).decode()}")
