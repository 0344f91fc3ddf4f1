"""Compile an MJCF in a process that may crash: `python _compile_worker.py LIBRARY PLUGINS SECONDS BYTES FILE.xml`.

MuJoCo crashes on some files. This file is executed by path and uses the C library alone: importing `mujoco` takes six
times as long. Writes the model in MuJoCo's binary format to standard output; the last line of standard error is JSON:
the error, or null, and warnings.
"""

import ctypes
import json
import os
import resource
import sys
from contextlib import suppress

KILL, PR_SET_PDEATHSIG = 9, 1
REPORTED = ctypes.CFUNCTYPE(None, ctypes.c_char_p)


def main(library: str, plugins: str, seconds: str, size: str, file: str) -> None:
    limit_process(int(seconds), int(size))
    lib = ctypes.CDLL(library)
    for folder, _, names in os.walk(plugins):  # in the order of MuJoCo's own package, which numbers plugins
        for name in names:
            if name.endswith((".so", ".dylib")):
                ctypes.CDLL(os.path.join(folder, name))
    warnings: list[str] = []

    def end(error: bytes | None = None) -> None:
        report = {"error": None if error is None else error.decode(errors="replace"), "warnings": warnings}
        os.write(2, f"\n{json.dumps(report)}\n".encode())
        os._exit(0 if error is None else 1)

    fatal, warned = REPORTED(end), REPORTED(lambda text: warnings.append(text.decode(errors="replace")))
    ctypes.c_void_p.in_dll(lib, "mju_user_error").value = ctypes.cast(fatal, ctypes.c_void_p).value
    ctypes.c_void_p.in_dll(lib, "mju_user_warning").value = ctypes.cast(warned, ctypes.c_void_p).value
    lib.mj_loadXML.restype, lib.mj_sizeModel.restype = ctypes.c_void_p, ctypes.c_int64
    error = ctypes.create_string_buffer(2000)
    model = ctypes.c_void_p(lib.mj_loadXML(os.fsencode(file), None, error, len(error)))
    if not model:
        end(error.value)
    content = ctypes.create_string_buffer(lib.mj_sizeModel(model))
    lib.mj_saveModel(model, None, content, ctypes.c_int64(len(content)))
    sys.stdout.buffer.write(content)
    sys.stdout.buffer.flush()
    end()


def limit_process(seconds: int, size: int) -> None:
    """Limit time and memory, write no core, end with the parent, and be the first to go when memory is short."""
    for which, limit in {resource.RLIMIT_CPU: seconds, resource.RLIMIT_AS: size, resource.RLIMIT_CORE: 0}.items():
        with suppress(ValueError, OSError):  # macOS has no limit on memory
            hard = resource.getrlimit(which)[1]
            limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
            resource.setrlimit(which, (limit, limit))
    with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, KILL)


if __name__ == "__main__":
    main(*sys.argv[1:])
