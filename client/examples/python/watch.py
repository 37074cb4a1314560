#!/usr/bin/env python3
"""Watches a whole Aureole world and plays with one body of it.

The rules that this follows are the comments of proto/aureole/v1/simulation.proto.
"""

import argparse
import contextlib
import dataclasses
import importlib
import itertools
import json
import math
import pathlib
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import types

import grpc

RADIUS = 0.5  # m
MASS = 100  # kg
PRECISION = 0.0005  # m: the bound of Precision.FINE
CELL = 32  # m
PROTO = pathlib.Path(__file__).resolve().parents[3] / "proto"


# ---- vectors ----


def add(a, b):
    return [x + y for x, y in zip(a, b, strict=True)]


def scale(a, factor):
    return [x * factor for x in a]


def subtract(a, b):
    return add(a, scale(b, -1))


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def vec3(a):
    return {"x": a[0], "y": a[1], "z": a[2]}


# ---- the merged state ----


@dataclasses.dataclass
class Body:
    """What one region tells of a body: integers in the units of Precision.FINE."""

    epoch: int
    cell: tuple[int, int]
    integers: list[int]  # of the position
    turn: list[int]  # three parts of the quaternion
    largest: int
    asleep: bool = False
    tick: int = 0

    @property
    def position(self):
        """Metres."""
        return add(scale(self.integers, 1 / 2048), [CELL * self.cell[0], 0, CELL * self.cell[1]])

    @property
    def orientation(self):
        """x, y, z, w."""
        parts = scale(self.turn, 1 / 4096)
        parts.insert(self.largest, math.sqrt(max(0, 1 - dot(parts, parts))))
        return parts


@dataclasses.dataclass
class Region:
    tick: int = 0  # of the newest complete frame
    frame: int = 0  # of the newest frame
    bodies: dict[int, Body] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Move:
    """A body on its way: a region has told where it went, the other one does not yet tell of it."""

    to: int
    epoch: int
    tick: int
    last: Body | None


def threes(column):
    return zip(*[iter(column)] * 3, strict=True)


class Merged:
    """What the streams of all regions tell, as one world."""

    def __init__(self, regions):
        self.regions = {region: Region() for region in regions}
        self.moves = {}
        self.removed = {}  # the tick of it; until all regions are past it, one may still tell of the body
        self.descriptions = {}

    def read(self, frame):
        region = self.regions[frame.region]
        if frame.base_tick == 0:
            region.bodies.clear()
        elif frame.base_tick != region.frame:
            raise RuntimeError(f"region {frame.region}: a frame was lost")
        for described in frame.described:
            self.descriptions.update(dict.fromkeys(itertools.accumulate(described.body), described))
        for cell in frame.cells:
            self.read_cell(region, cell, frame.tick)
        for dropped in zip(frame.dropped[::2], frame.dropped[1::2], strict=True):
            region.bodies = {body: it for body, it in region.bodies.items() if it.cell != dropped}
        passed = itertools.accumulate(frame.passed)
        columns = (frame.passed_region, frame.passed_epoch, frame.passed_tick)
        for body, to, epoch, ticks in zip(passed, *columns, strict=True):
            self.move(region, body, to, epoch, frame.tick + ticks)
        region.frame = frame.tick
        if not frame.more:
            region.tick = frame.tick
        self.settle()

    def read_cell(self, region, cell, tick):
        bodies = region.bodies
        ids = itertools.accumulate(cell.id)
        for body, position, turn in zip(ids, threes(cell.position), threes(cell.orientation), strict=True):
            it = bodies[body]
            it.integers = add(it.integers, position)
            it.turn = add(it.turn, turn)

        moved = zip(cell.moved_epoch, cell.moved_tick, strict=True)
        for body, why in zip(itertools.accumulate(cell.gone), cell.why, strict=True):
            if why == 0:
                # It may be in another cell of this region already.
                if body in bodies and bodies[body].cell == (cell.x, cell.z):
                    del bodies[body]
            elif why == 1:
                for told in (bodies, self.moves, self.descriptions):
                    told.pop(body, None)
                self.removed[body] = tick
            else:
                epoch, ticks = next(moved)
                self.move(region, body, why - 2, epoch, tick + ticks)

        ids = itertools.accumulate(cell.new_id)
        columns = (cell.new_epoch, threes(cell.new_position), threes(cell.new_orientation), cell.new_largest)
        for body, epoch, position, turn, largest in zip(ids, *columns, strict=True):
            bodies[body] = Body(epoch, (cell.x, cell.z), list(position), list(turn), largest)

        for column, asleep in ((cell.slept, True), (cell.woke, False)):
            for body in itertools.accumulate(column):
                if body in bodies:
                    bodies[body].asleep = asleep

    def move(self, region, body, to, epoch, tick):
        """`region` tells that the body belongs to `to` from a tick on: it is shown as it was until that tells of it."""
        last = region.bodies.get(body)
        if last and last.epoch < epoch:
            last.tick = region.tick
            del region.bodies[body]
        else:
            last = None  # it is back already, or was never told
        known = self.moves.get(body)
        if known and known.last and not (last and last.epoch > known.last.epoch):
            last = known.last
        if known and known.epoch > epoch:
            known.last = last
        else:
            self.moves[body] = Move(to, epoch, tick, last)

    def settle(self):
        """Forgets what all have caught up with."""
        for body in [b for b, move in self.moves.items() if self.regions[move.to].tick >= move.tick]:
            del self.moves[body]
            if not self.find(body):
                self.descriptions.pop(body, None)  # removed on its way
        self.removed = {b: tick for b, tick in self.removed.items() if self.tick() < tick}

    def tick(self):
        """The last tick that all regions have told; 0 until all have."""
        return min(region.tick for region in self.regions.values())

    def find(self, body):
        """Where two regions tell of a body, the one with the higher epoch is right."""
        if body in self.removed:
            return None
        told = [dataclasses.replace(r.bodies[body], tick=r.tick) for r in self.regions.values() if body in r.bodies]
        if body in self.moves and self.moves[body].last:
            told.append(self.moves[body].last)
        return max(told, key=lambda it: it.epoch, default=None)

    def all(self):
        every = set(self.moves).union(*(region.bodies for region in self.regions.values()))
        return [it for it in map(self.find, every) if it]


# ---- the servers ----


def load(proto):
    """The modules of the interface, generated into a folder that is gone after they are loaded."""
    # Debian's grpc_tools is too old for this proto3, pip's is not: so prefer the plain compiler where it is.
    plugin = shutil.which("grpc_python_plugin")
    protoc = [sys.executable, "-m", "grpc_tools.protoc"]
    if plugin:
        protoc = ["protoc", f"--plugin=protoc-gen-grpc_python={plugin}"]
    with tempfile.TemporaryDirectory() as folder:
        files = [f"aureole/v1/{name}.proto" for name in ("types", "world", "error", "simulation")]
        outputs = [f"--python_out={folder}", f"--grpc_python_out={folder}"]
        subprocess.run([*protoc, f"-I{proto}", *outputs, *files], check=True)
        sys.path.insert(0, folder)
        names = ("error_pb2", "simulation_pb2", "simulation_pb2_grpc")
        errors, simulation, services = (importlib.import_module(f"aureole.v1.{name}") for name in names)
    return types.SimpleNamespace(errors=errors, simulation=simulation, services=services)


def explain(error, errors):
    """What a server says of a refusal: reason, field and remedy."""
    if not isinstance(error, grpc.RpcError):
        return f"{error}"
    lines = [f"{error.code().name}: {error.details()}"]
    for key, value in error.trailing_metadata() or ():
        if key == "grpc-status-details-bin":
            detail = errors.ErrorDetail()
            errors.ErrorStatus.FromString(value).details[0].Unpack(detail)
            reason = errors.Reason.Name(detail.reason)
            lines += [f"reason: {reason}", f"field: {detail.field or '(none)'}", f"remedy: {detail.remedy}"]
    return "\n  ".join(lines)


class World:
    """All servers of a world. One thread per server reads its stream; `changed` guards what they write."""

    def __init__(self, server, interface, stack):
        def connect(endpoint):
            return interface.services.SimulationStub(stack.enter_context(grpc.insecure_channel(endpoint)))

        self.interface = interface
        self.simulation = interface.simulation
        about = connect(server).GetWorld(self.simulation.GetWorldRequest(), timeout=10)
        self.layout_epoch = about.layout_epoch
        # A region that has left has none.
        servers = {region: connect(endpoint) for region, endpoint in enumerate(about.endpoints) if endpoint}
        self.servers = list(servers.values())
        self.merged = Merged(servers)
        self.changed = threading.Condition()
        self.failure = None
        self.frames = self.bytes = 0
        for stub in self.servers:
            threading.Thread(target=self.follow, args=(stub,), daemon=True).start()
        self.until("all regions are seen", self.merged.tick)

    def follow(self, stub):
        try:
            for frame in stub.StreamReplicas(self.simulation.StreamReplicasRequest()):
                with self.changed:
                    if frame.layout_epoch != self.layout_epoch:
                        raise RuntimeError("the layout has changed")
                    self.merged.read(frame)
                    self.frames += 1
                    self.bytes += frame.ByteSize()
                    self.changed.notify_all()
            raise RuntimeError("a stream ended")
        except Exception as error:  # told to the main thread, whatever it is
            with self.changed:
                self.failure = self.failure or error
                self.changed.notify_all()

    def until(self, what, condition):
        with self.changed:
            value = self.changed.wait_for(lambda: self.failure or condition(), timeout=20)
            if self.failure:
                raise self.failure
            if not value:
                raise TimeoutError(f"waited for 20 s until {what}")
            return value


# ---- what to do ----


def watch(world, seconds):
    for _ in range(seconds):
        with world.changed:
            world.frames = world.bytes = 0
        time.sleep(1)
        with world.changed:
            if world.failure:
                raise world.failure
            bodies = world.merged.all()
            line = {"tick": world.merged.tick(), "bodies": len(bodies), "asleep": sum(it.asleep for it in bodies),
                    "frames": world.frames, "bytes": world.bytes}
        print(json.dumps(line), flush=True)


def cast_onto(world, body):
    """Casts a ray from behind the body along its way, so that it is on the ray however far it has come meanwhile."""
    for _ in range(20):
        before = world.until("the sphere is seen", lambda: world.merged.find(body))
        now = world.until("the sphere goes on", lambda: found_after(world, body, before.tick + 1))
        way = subtract(now.position, before.position)
        step = math.hypot(*way)
        direction = scale(way, 1 / step) if step > 0.001 else [0, -1, 0]
        ray = {"origin": vec3(subtract(now.position, scale(direction, 2))), "direction": vec3(direction), "length": 10}
        request = world.simulation.CastRaysRequest(rays=[ray])
        calls = [server.CastRays.future(request, timeout=10) for server in world.servers]
        hits = [(answer.hits[0], answer.tick) for answer in (call.result() for call in calls)]
        hit, tick = min(hits, key=lambda it: it[0].distance if it[0].body else math.inf)
        if hit.body == body:
            return hit, tick, now, step
    raise RuntimeError("other bodies are in the way of all rays")


def found_after(world, body, tick):
    it = world.merged.find(body)
    return it if it and it.tick >= tick else None


def accepted(world, answer):
    """What was refused of a call that went on is a surprise here."""
    name = world.interface.errors.Reason.Name
    if answer.rejected:
        raise RuntimeError("rejected: " + ", ".join(f"{name(it.reason)} ({it.count})" for it in answer.rejected))
    return answer


def play(world, at, push):
    simulation, merged, server = world.simulation, world.merged, world.servers[0]
    client = secrets.randbelow(2**64 - 1) + 1  # any number but 0

    sphere = {"shape": {"sphere": {"radius": RADIUS}}, "mass": MASS, "position": vec3(at)}
    request = simulation.SpawnBodiesRequest(client=client, sequence=1, bodies=[sphere])
    spawned = accepted(world, server.SpawnBodies(request, timeout=10))
    body = spawned.body[0]
    start = world.until("the sphere is seen", lambda: merged.find(body))
    if merged.descriptions[body].shape.sphere.radius != RADIUS:
        raise RuntimeError(f"the body that came is no such sphere: {merged.descriptions[body]}")

    impulse = {"sequence": 2, "body": body, "impulse": vec3(push)}
    batches = iter([simulation.ImpulseBatch(client=client, impulse=[impulse])])
    pushed = accepted(world, server.ApplyImpulses(batches, timeout=10))

    def moves():
        it = found_after(world, body, pushed.last_tick)
        return it and dot(subtract(it.position, start.position), push) > 0.1 * math.hypot(*push)

    world.until("the sphere moves; is something in its way?", moves)

    hit, tick, now, step = cast_onto(world, body)
    after = world.until("the tick of the hit is seen", lambda: found_after(world, body, tick))
    # The hit is on the surface, at a tick between those of `now` and `after`: where the sphere then was, is estimated.
    way = subtract(after.position, now.position)
    then = add(now.position, scale(way, (tick - now.tick) / (after.tick - now.tick or 1)))
    off = abs(math.dist([hit.point.x, hit.point.y, hit.point.z], then) - RADIUS)
    meanwhile = 0 if tick in (now.tick, after.tick) else step + math.hypot(*way)
    if off > PRECISION + meanwhile:
        raise RuntimeError(f"the hit is {off} m off the sphere, which has moved by {meanwhile} m meanwhile")

    with world.changed:
        end, bodies = merged.find(body), len(merged.all())
    request = simulation.RemoveBodiesRequest(client=client, sequence=3, body=[body])
    gone = accepted(world, server.RemoveBodies(request, timeout=10))
    world.until("the sphere is gone", lambda: merged.tick() >= gone.tick and not merged.find(body))

    print(json.dumps({
        "tick": merged.tick(),
        "bodies": bodies,
        "spawned": str(body),  # many readers of JSON would lose digits of a number
        "moved": round(math.dist(end.position, start.position), 5),
        "position": [round(value, 5) for value in end.position],
        "orientation": [round(value, 5) for value in end.orientation],  # x, y, z, w
        "hit_distance": round(hit.distance, 5),
        "hit_off": round(off, 5),
        "outcomes": {
            "spawned": len(spawned.body),
            "applied": pushed.applied,
            "removed": gone.removed,
        },
    }))


def vector(text):
    values = [float(part) for part in text.split(",")]
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise ValueError(text)
    return values


def seconds(text):
    if int(text) < 1:
        raise ValueError(text)
    return int(text)


def main():
    parser = argparse.ArgumentParser(description="Watches an Aureole world and plays with one body of it.")
    parser.add_argument("--server", required=True, metavar="HOST:PORT", help="any region server")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--spawn", type=vector, metavar="=X,Y,Z", help="where to put a sphere, m; with the '='")
    what.add_argument("--watch", type=seconds, metavar="SECONDS")
    parser.add_argument("--push", type=vector, metavar="=X,Y,Z", default=[300, 0, 0], help="its impulse, N s")
    parser.add_argument("--proto", default=PROTO, metavar="FOLDER", help="the interface files")
    options = parser.parse_args()
    if not any(options.push):
        parser.error("--push must not be 0")

    try:
        interface = load(options.proto)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"watch.py: {error}", file=sys.stderr)
        return 1
    try:
        with contextlib.ExitStack() as stack:
            world = World(options.server, interface, stack)
            if options.watch:
                watch(world, options.watch)
            else:
                play(world, options.spawn, options.push)
    except Exception as error:
        print(f"watch.py: {explain(error, interface.errors)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
