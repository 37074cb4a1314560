#!/usr/bin/env python3
"""Holds the include directions: who may include whom, and what the core may not touch.

server/core includes only itself, Abseil, Eigen and the standard library; physics -> core; transport -> core, proto;
region, replay -> core, physics, transport, proto; control -> core, transport, proto (the messages of the service it is);
client -> proto (client/cli also server/control, server/replay); tests may include everything, and nothing but tests includes tests.
server/core and server/physics are pure functions of their inputs: no clock, thread, file, socket or random device.

Usage: include_directions.py [--root DIR] | --self-test
"""

import argparse
import pathlib
import re
import sys
import tempfile

# Component -> the components of ours its files may include. The longest matching prefix is the component of a file.
ALLOWED = {
    "server/core": {"server/core"},
    "server/physics": {"server/physics", "server/core"},
    "server/transport": {"server/transport", "server/core", "proto"},
    "server/region": {"server/region", "server/core", "server/physics", "server/transport", "proto"},
    "server/replay": {"server/replay", "server/core", "server/physics", "server/transport", "proto"},
    "server/control": {"server/control", "server/core", "server/transport", "proto"},
    "client": {"client", "proto"},
    "client/cli": {"client/cli", "client", "proto", "server/control", "server/replay"},
    "proto": {"proto"},
    "tests": None,  # everything
}

PURE = {"server/core", "server/physics"}
IMPURE = re.compile(
    r"thread|mutex|shared_mutex|condition_variable|future|stop_token|semaphore|barrier|latch|chrono|ctime|time\.h|"
    r"random|fstream|iostream|filesystem|csignal|signal\.h|unistd\.h|fcntl\.h|poll\.h|netdb\.h|pthread\.h|"
    r"sys/.*|netinet/.*|arpa/.*|net/.*|absl/synchronization/.*|absl/time/clock\.h|absl/random/.*|"
    r"grpc.*|google/protobuf/.*|prometheus/.*|spdlog/.*")
CORE_LIBRARIES = ("absl/", "Eigen/")

INCLUDE = re.compile(r'^\s*#\s*include\s*(["<])([^">]+)[">]')
SOURCES = {".h", ".hh", ".hpp", ".cc", ".cpp"}


def component_of_file(path):
    parts = path.split("/")
    for length in (2, 1):
        if len(parts) > length and "/".join(parts[:length]) in ALLOWED:
            return "/".join(parts[:length])
    return None


def component_of_include(name):
    """Whose header `name` is: a component of ours, None when it is a library's, "?" when it is ours but nobody's."""
    if name.startswith("aureole/v1/"):
        return "proto"  # generated
    if name.startswith("aureole/"):
        return "client"  # client/include/aureole
    if name.split("/")[0] in ("server", "client", "proto", "tests"):
        return component_of_file(name) or "?"
    return None


def fault_of_include(root, path, quoted, name):
    """Why the file at `path` must not include `name`, or None."""
    component = component_of_file(path)
    target = component_of_include(name)
    if component in PURE and IMPURE.fullmatch(name):
        return f"{component} has no clock, thread, file, socket or randomness"
    if ".." in name.split("/"):
        return "write the path from the root of the repository"
    if target is None:
        if quoted and (root / path).parent.joinpath(name).is_file():
            return "write the path from the root of the repository"
        if component == "server/core" and ("/" in name or name.endswith(".h")) and not name.startswith(CORE_LIBRARIES):
            return "server/core uses the standard library, Abseil and Eigen only"
        return None
    allowed = ALLOWED[component]
    if allowed is not None and target not in allowed:
        return f"{component} may include of ours only: {', '.join(sorted(allowed))}"
    return None


def faults(root):
    """(path, line, include, reason) of every include that goes the wrong way, and the number of files read."""
    found, read = [], 0
    for path in sorted(p for top in ("server", "client", "proto", "tests") for p in (root / top).rglob("*")):
        relative = path.relative_to(root).as_posix()
        if path.suffix not in SOURCES or "node_modules" in path.parts:
            continue
        if component_of_file(relative) is None:
            found.append((relative, 0, "", "in no component that tests/include_directions.py knows"))
            continue
        read += 1
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            match = INCLUDE.match(line)
            if match:
                reason = fault_of_include(root, relative, match[1] == '"', match[2])
                if reason:
                    found.append((relative, number, match[2], reason))
    return found, read


# (file, include line, is it a fault?)
SELF_TEST = [
    ("server/core/a.cc", '#include "server/core/b.h"', False),
    ("server/core/a.cc", '#include "absl/status/status.h"', False),
    ("server/core/a.cc", "#include <Eigen/Core>", False),
    ("server/core/a.cc", "#include <vector>", False),
    ("server/core/a.cc", '#include "server/physics/b.h"', True),
    ("server/core/a.cc", '#include "aureole/v1/types.pb.h"', True),
    ("server/core/a.cc", '#include "b.h"', True),
    ("server/core/a.cc", '#include "../core/b.h"', True),
    ("server/core/a.cc", "#include <btBulletDynamicsCommon.h>", True),
    ("server/core/a.cc", "#include <nlohmann/json.hpp>", True),
    ("server/core/a.cc", '#include "absl/time/clock.h"', True),
    ("server/core/a.cc", "#include <sys/socket.h>", True),
    *(("server/core/a.cc", f"#  include <{h}>", True)
      for h in ("thread", "mutex", "chrono", "fstream", "iostream", "random")),
    ("server/physics/a.cc", '#include "server/core/b.h"', False),
    ("server/physics/a.cc", "#include <btBulletDynamicsCommon.h>", False),
    ("server/physics/a.cc", "#include <chrono>", True),
    ("server/physics/a.cc", "#include <grpcpp/grpcpp.h>", True),
    ("server/physics/a.cc", '#include "server/transport/b.h"', True),
    ("server/transport/a.cc", '#include "aureole/v1/peer.grpc.pb.h"', False),
    ("server/transport/a.cc", "#include <thread>", False),
    ("server/transport/a.cc", '#include "server/physics/b.h"', True),
    ("server/transport/a.cc", '#include "server/region/b.h"', True),
    ("server/region/a.cc", '#include "server/physics/b.h"', False),
    ("server/region/a.cc", '#include "server/control/b.h"', True),
    ("server/control/a.cc", '#include "server/transport/b.h"', False),
    ("server/control/a.cc", '#include "server/region/b.h"', True),
    ("client/src/a.cc", '#include "aureole/v1/simulation.grpc.pb.h"', False),
    ("client/src/a.cc", '#include "server/core/b.h"', True),
    ("client/cli/a.cc", '#include "server/control/b.h"', False),
    ("client/cli/a.cc", '#include "server/region/b.h"', True),
    ("server/region/a.cc", '#include "tests/simulation/b.h"', True),
    ("tests/simulation/a.cc", '#include "server/region/b.h"', False),
    ("server/other/a.cc", "#include <vector>", True),
]


def self_test():
    for path, line, expected in SELF_TEST:
        with tempfile.TemporaryDirectory() as directory:
            root = pathlib.Path(directory)
            (root / path).parent.mkdir(parents=True)
            (root / path).with_name("b.h").write_text("")
            (root / path).write_text(f"// a file\n{line}\n")
            found, _ = faults(root)
            if bool([fault for fault in found if fault[0] == path]) != expected:
                sys.exit(f"self-test: {path}: {line}: {'not refused' if expected else f'refused: {found}'}")
    print(f"self-test: {len(SELF_TEST)} cases, {sum(case[2] for case in SELF_TEST)} of them refused as they should be")


def main():
    parser = argparse.ArgumentParser(description="Checks who includes whom.")
    parser.add_argument("--root", type=pathlib.Path, default=pathlib.Path(__file__).resolve().parent.parent)
    parser.add_argument("--self-test", action="store_true", help="prove that each rule goes red")
    arguments = parser.parse_args()
    if arguments.self_test:
        return self_test()
    found, read = faults(arguments.root)
    for path, line, name, reason in found:
        print(f"{path}:{line}: {name}: {reason}", file=sys.stderr)
    if found or not read:
        sys.exit(f"include directions: {len(found)} of {read} files' includes go the wrong way" if read else
                 f"include directions: no sources below {arguments.root}")
    print(f"include directions: {read} files")


if __name__ == "__main__":
    main()
