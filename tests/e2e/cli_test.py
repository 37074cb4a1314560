"""The command line as a user meets it: on a terminal, in a pipe, with bad input, with processes that die.

Usage: cli_test.py BIN_DIRECTORY SOURCE_DIRECTORY
"""

import contextlib
import fcntl
import json
import os
import pathlib
import pty
import select
import signal
import stat
import subprocess
import sys
import tempfile
import termios
import threading
import time
import unittest

BIN = pathlib.Path(sys.argv[1])
SOURCE = pathlib.Path(sys.argv[2])
WORLDS = SOURCE / "tests" / "worlds"
AUREOLE = str(BIN / "aureole")
DEADLINE_S = 60


def children(pid):
    found = []
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        with contextlib.suppress(OSError):
            fields = pathlib.Path("/proc", entry, "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == pid and fields[0] != "Z":
                found.append(int(entry))
    return sorted(found)


def alive(pid):
    with contextlib.suppress(OSError):
        return pathlib.Path("/proc", str(pid), "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def wait_for(condition, what):
    until = time.monotonic() + DEADLINE_S
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > until:
            raise AssertionError("never happened: " + what)
        time.sleep(0.01)


class Cli(unittest.TestCase):
    def setUp(self):
        self.directory = tempfile.TemporaryDirectory()
        self.path = pathlib.Path(self.directory.name)
        self.processes = []

    def tearDown(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.wait()
            for stream in (process.stdout, process.stderr):
                if stream:
                    stream.close()
        self.directory.cleanup()

    def fake(self, flags=""):
        """A region server without a world; leaves a mark when it is started."""
        script = self.path / "server"
        script.write_text(f'#!/bin/sh\ntouch {self.path}/started\nexec {BIN}/fake_region {flags} "$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
        return ["--region-server", str(script)]

    def started(self):
        return (self.path / "started").exists()

    def start(self, *arguments, **kwargs):
        environment = {**os.environ, "TMPDIR": self.directory.name}  # logs that are kept go with the test
        kwargs = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment, **kwargs}
        process = subprocess.Popen([AUREOLE, *map(str, arguments)], **kwargs)
        self.processes.append(process)
        return process

    def run_cli(self, *arguments):
        process = self.start(*arguments)
        out, err = process.communicate(timeout=DEADLINE_S)
        return process.returncode, out, err

    def servers_of(self, process, number):
        return wait_for(lambda: (lambda c: c if len(c) == number else None)(children(process.pid)), "servers")

    def assert_gone(self, pids):
        wait_for(lambda: not any(alive(p) for p in pids), f"end of {pids}")


class Terminal(Cli):
    def test_table_is_redrawn_in_place_and_control_c_ends_everything(self):
        master, slave = pty.openpty()
        process = self.start("up", WORLDS / "demo.json", *self.fake(), stdin=slave, stdout=slave, stderr=slave,
                             start_new_session=True, text=False,
                             preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0))
        os.close(slave)
        text = b""
        until = time.monotonic() + DEADLINE_S
        while text.count(b"demo: running") < 2 and time.monotonic() < until:
            if select.select([master], [], [], 1)[0]:
                text += os.read(master, 65536)
        self.assertGreaterEqual(text.count(b"demo: running, 4 regions"), 2)
        self.assertIn(b"\x1b[10A", text)  # ten lines up, over what was drawn before
        for word in (b"region ", b"awake", b"asleep", b"p99 ms", b"transfers", b"waits", b"violations", b"all "):
            self.assertIn(word, text)
        servers = self.servers_of(process, 4)
        os.write(master, b"\x03")
        self.assertEqual(process.wait(DEADLINE_S), 0)
        self.assert_gone(servers)
        os.close(master)


class Processes(Cli):
    def test_killed_parent_leaves_no_server(self):
        process = self.start("up", WORLDS / "demo.json", *self.fake())
        servers = self.servers_of(process, 4)
        process.kill()
        self.assert_gone(servers)

    def test_killed_server_is_replaced_and_the_run_goes_on(self):
        process = self.start("up", WORLDS / "demo.json", "--duration", "6s", "--data", self.path / "data", "--json")
        servers = self.servers_of(process, 4)
        wait_for(lambda: (self.path / "data/region-2/i1/checkpoint").exists(), "a checkpoint")
        time.sleep(1.5)  # it ticks
        os.kill(servers[2], signal.SIGKILL)
        out, err = process.communicate(timeout=DEADLINE_S)
        self.assertEqual(process.returncode, 0, err)
        self.assertIn("region 2: incarnation 2 is started: killed by signal 9 (Killed)", err)
        whole = self.run_cli("up", WORLDS / "demo.json", "--duration", "6s", "--undivided", "--no-real-time", "--json")
        self.assertEqual(json.loads(out)["hashes"], json.loads(whole[1])["hashes"])
        self.assert_gone(servers)

    def test_killed_control_plane_leaves_its_servers_to_the_next(self):
        with tempfile.TemporaryDirectory() as directory:
            store = pathlib.Path(directory, "control.db")
            command = [str(BIN / "aureole-control"), str(WORLDS / "demo.json"), "--store", str(store)]

            def control():
                process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
                self.addCleanup(process.kill)
                lines = []

                def read():
                    lines.extend(iter(process.stderr.readline, ""))

                threading.Thread(target=read, daemon=True).start()
                wait_for(lambda: any("running, 4 regions" in line for line in lines), "running")
                return process, lines

            def servers():
                files = pathlib.Path(directory, "data").glob("region-*.server")
                return sorted(int(file.read_text().split()[2]) for file in files)

            first, _ = control()
            pids = servers()
            self.assertEqual(len(pids), 4)
            first.kill()
            first.wait()
            second, lines = control()
            wait_for(lambda: sum("a control plane of epoch 2 is there" in line for line in lines) == 4, "four join again")
            self.assertEqual(servers(), pids)
            os.kill(pids[0], signal.SIGKILL)
            wait_for(lambda: any("incarnation 2 is started" in line for line in lines), "replaced")
            wait_for(lambda: pids[0] not in servers() and len(servers()) == 4, "its successor")
            pids = servers()
            second.terminate()
            self.assertEqual(second.wait(DEADLINE_S), 0)
            wait_for(lambda: any("left; 4 servers go on" in line for line in lines), "told")
            self.assertTrue(all(alive(pid) for pid in pids))
            third, _ = control()
            words = pathlib.Path("/proc", str(pids[0]), "cmdline").read_text().split("\0")
            address = words[words.index("--control") + 1]
            out = subprocess.run([AUREOLE, "events", "--control", address, "--json"], stdout=subprocess.PIPE, text=True,
                                 timeout=DEADLINE_S, check=True).stdout
            event = json.loads(out)
            self.assertEqual((event["kind"], event["warning"]), ("REGION_REPLACED", True), "of the control plane before")
            again = subprocess.run([AUREOLE, "events", "--control", address, "--after", event["sequence"]],
                                   stdout=subprocess.PIPE, text=True, timeout=DEADLINE_S, check=True).stdout
            self.assertEqual(again, "")
            follower = subprocess.Popen([AUREOLE, "events", "--control", address, "--follow"], stdout=subprocess.PIPE,
                                        text=True)
            self.addCleanup(follower.kill)
            self.assertIn(" warning REGION_REPLACED region ", follower.stdout.readline())
            follower.send_signal(signal.SIGINT)
            self.assertEqual(follower.wait(DEADLINE_S), 0)
            out = subprocess.run([AUREOLE, "checkpoint", "--control", address, "--json"], stdout=subprocess.PIPE, text=True,
                                 timeout=DEADLINE_S, check=True).stdout
            saved = json.loads(out)
            self.assertEqual([region["region"] for region in saved["regions"]], [0, 1, 2, 3])
            self.assertTrue(all(int(region["tick"]) >= int(saved["tick"]) > 0 for region in saved["regions"]), saved)
            third.send_signal(signal.SIGINT)
            self.assertEqual(third.wait(DEADLINE_S), 0)
            self.assertFalse(any(alive(pid) for pid in pids))

    def test_killed_server_without_checkpoints_fails_the_run_by_name(self):
        process = self.start("up", WORLDS / "demo.json", "--checkpoint-every", "0", *self.fake())
        servers = self.servers_of(process, 4)
        wait_for(lambda: "tick" in process.stdout.readline(), "a tick")
        os.kill(servers[2], signal.SIGKILL)
        out, err = process.communicate(timeout=DEADLINE_S)
        self.assertEqual(process.returncode, 1, err)
        self.assertIn("the server of region 2 ended: killed by signal 9 (Killed)", err)
        self.assert_gone(servers)

    def test_server_that_fails_shows_the_tail_of_its_log(self):
        code, _, err = self.run_cli("up", WORLDS / "demo.json", "--duration", "60s", "--logs", self.path / "logs",
                                    *self.fake("--die-at 50 --fail-region 1"))
        self.assertEqual(code, 1)
        self.assertIn("the server of region 1 ended: exit status 3; its log is ", err)
        self.assertIn("  | fake: dies at tick 50", err)

    def test_terminate_and_hang_up_end_everything(self):
        for number in (signal.SIGTERM, signal.SIGHUP):
            process = self.start("up", WORLDS / "demo.json", *self.fake())
            servers = self.servers_of(process, 4)
            process.send_signal(number)
            process.communicate(timeout=DEADLINE_S)
            self.assertEqual(process.returncode, 0)
            self.assert_gone(servers)

    def test_second_interrupt_kills_servers_that_take_their_time(self):
        process = self.start("up", WORLDS / "demo.json", "--duration", "60s", *self.fake("--ignore-stop"))
        servers = self.servers_of(process, 4)
        wait_for(lambda: "tick" in process.stdout.readline(), "a tick")
        began = time.monotonic()
        wait_for(lambda: process.send_signal(signal.SIGINT) or process.poll() is not None, "the end")
        self.assertLess(time.monotonic() - began, 8)
        self.assertEqual(process.returncode, 130)
        self.assert_gone(servers)

    def test_reader_that_goes_away_ends_the_run(self):
        process = self.start("up", WORLDS / "demo.json", *self.fake())
        servers = self.servers_of(process, 4)
        process.stdout.readline()
        process.stdout.close()
        process.stdout = None
        process.communicate(timeout=DEADLINE_S)
        self.assert_gone(servers)


class Input(Cli):
    def refused(self, *arguments):
        code, out, err = self.run_cli(*arguments, *self.fake())
        self.assertEqual(code, 2, err)
        self.assertEqual(out, "")
        self.assertFalse(self.started(), "nothing is started")
        return err

    def test_every_broken_world_is_refused_with_its_path(self):
        bad = sorted((WORLDS / "bad").glob("*.json"))
        self.assertGreaterEqual(len(bad), 40)
        for world in bad:
            err = self.refused("up", world)
            self.assertTrue(err.startswith(f"{world}: "), err)
            self.assertGreater(len(err.split(": ")), 2, err)

    def test_missing_file_and_directory_are_refused(self):
        self.assertIn("nowhere.json: ", self.refused("up", self.path / "nowhere.json"))
        self.assertIn(f"{self.path}: ", self.refused("up", self.path))
        self.assertIn("nowhere.json: ", self.refused("experiment", WORLDS / "demo.json", self.path / "nowhere.json"))

    def test_bad_flags_are_refused_with_the_flag(self):
        demo = WORLDS / "demo.json"
        for flags, word in ((["--duration", "5 parsecs"], "--duration"), (["--duration", "-3s"], "--duration"),
                            (["--duration", "inf"], "--duration"), (["--hash-every", "-1"], "--hash-every"),
                            (["--frobnicate"], "--frobnicate")):
            self.assertIn(word, self.refused("up", demo, *flags))
        for flags, word in ((["--regions", "4"], "'4' is not MIN..MAX"), (["--regions", "0..4"], "--regions: min is 0"),
                            (["--regions", "5..4"], "--regions: min is 5, above max 4"),
                            (["--regions", "1..65"], "--regions: max is 65"),
                            (["--regions", "1..4", "--undivided"], "leave out --regions, or --undivided"),
                            (["--regions", "1..4", "--frame-percent", "0"], "--frame-percent: is 0"),
                            (["--regions", "1..4", "--awake-bodies", "-1"], "--awake-bodies: is -1"),
                            (["--regions", "1..4", "--up-after", "soon"], "--up-after"),
                            (["--regions", "1..4", "--down-after", "1s"], "--down-after: must be a time from upAfter"),
                            (["--awake-bodies", "10"], "--regions")):
            self.assertIn(word, self.refused("up", demo, *flags))
        delayed = self.path / "delayed.json"
        delayed.write_text(json.dumps({**json.loads(demo.read_text()), "exchange": {"delay": 1}}))
        self.assertIn("--regions: from 1 to 4 needs a layout that can change", self.refused("up", delayed, "--regions", "1..4"))
        self.assertIn("--repeat", self.refused("experiment", demo, "--repeat", "0"))
        self.assertIn("--policies", self.refused("experiment"))
        self.assertIn("--policies", self.refused("experiment", demo, "--policies"))
        self.assertIn("events: must be at most kMaxEvents",
                      self.refused("experiment", "--policies", "--duration", "12m", "--out", self.path / "out"))
        blocked = self.path / "file"
        blocked.write_text("")
        self.assertIn("--out", self.refused("experiment", demo, "--out", blocked / "below"))

    def test_check_describes_good_worlds_and_stops_at_a_broken_one(self):
        code, out, _ = self.run_cli("check", WORLDS / "demo.json")
        self.assertEqual(code, 0)
        for word in ("demo: 4 regions", "m = ", "paper (Eqs. 1-4): T_R", "ours (k = "):
            self.assertIn(word, out)
        broken = sorted((WORLDS / "bad").glob("*.json"))[0]
        code, _, err = self.run_cli("check", WORLDS / "demo.json", broken)
        self.assertEqual(code, 2)
        self.assertTrue(err.startswith(str(broken)))

    def test_help_has_examples_and_exit_codes(self):
        for command in ([], ["up"], ["experiment"], ["check"], ["watch"], ["push"], ["spawn"], ["remove"], ["load"],
                        ["ray"]):
            code, out, _ = self.run_cli(*command, "--help")
            self.assertEqual(code, 0)
            self.assertIn("Example", out)
            self.assertIn("Exit codes: 0 ", out)


class Completion(Cli):
    def test_scripts_complete_commands_and_options(self):
        for shell in ("bash", "zsh", "fish"):
            code, out, err = self.run_cli("completion", shell)
            self.assertEqual(code, 0, err)
            for word in ("record", "replay", "hash-every"):
                self.assertIn(word, out)
        script = self.run_cli("completion", "bash")[1]
        typed = script + "COMP_WORDS=(aureole rep); COMP_CWORD=1; _aureole; echo ${COMPREPLY[@]};"
        typed += "COMP_WORDS=(aureole replay --ver); COMP_CWORD=2; _aureole; echo ${COMPREPLY[@]}"
        out = subprocess.run(["bash", "-c", typed], capture_output=True, text=True, check=True).stdout
        self.assertEqual(out.split("\n")[:2], ["replay report", "--verify"])
        self.assertEqual(self.run_cli("completion", "tcsh")[0], 2)


class Clients(Cli):
    def setUp(self):
        super().setUp()
        up = self.start("up", WORLDS / "demo.json")
        line = ""
        while not line.startswith("servers: "):
            line = up.stdout.readline()
            self.assertTrue(line, "the run ended")
        self.servers = line.split()[1:]
        self.control = up.stdout.readline().split()[-1]
        # Read on, so that the run is not held up.
        threading.Thread(target=up.stdout.read, daemon=True).start()
        self.up = up

    def tearDown(self):
        self.up.send_signal(signal.SIGINT)
        self.up.wait(DEADLINE_S)
        super().tearDown()

    def ask(self, command, *arguments, server=0, code=0):
        got, out, err = self.run_cli(command, "--server", self.servers[server], *arguments)
        self.assertEqual(got, code, out + err)
        return out, err

    def bodies(self, *arguments, server=0):
        shown = json.loads(self.ask("watch", "--bodies", "--json", *arguments, server=server)[0])
        return {b["body"]: b for b in shown["bodies"]}

    def test_body_is_spawned_seen_pushed_and_removed_by_any_server(self):
        self.assertEqual(len(self.servers), 4)
        before = self.bodies()
        self.assertGreater(len(before), 200)
        spawned = int(self.ask("spawn", "--shape", "box:1,1,1", "--mass", 5, "--position", "0,50,0", server=1)[0])
        self.assertNotIn(spawned, before)
        body = self.bodies(server=2)[spawned]
        self.assertLess(body["position"][1], 50.1)
        out, _ = self.ask("push", "--body", spawned, "--velocity", "0,100,0", "--json", server=3)
        self.assertEqual(json.loads(out), {"applied": 1, "bodies": 1, "rejected": {}})
        self.assertGreater(self.bodies("--rect", "-9,9,-9,9")[spawned]["velocity"][1], 20)
        self.assertNotIn(spawned, self.bodies("--sphere", "300,300,10"))
        self.ask("spawn", "--shape", "box:4,1,4", "--position", "200,80,0", server=3)
        out, _ = self.ask("ray", "--from", "200,500,0", "--direction", "0,-1,0", "--json")
        hit = json.loads(out)
        self.assertFalse(hit["fixed"])
        self.assertGreater(hit["distance"], 419)
        self.assertEqual([round(x, 6) for x in hit["normal"]], [0, 1, 0])
        self.assertIn("(fixed)", self.ask("ray", "--from", "210,50,0", "--direction", "0,-1,0", server=2)[0])
        self.assertEqual(self.ask("ray", "--from", "0,500,0", "--direction", "0,1,0", code=1)[0], "nothing\n")
        self.assertEqual(self.ask("remove", spawned, server=2)[0], "1 of 1 removed\n")
        self.assertEqual(self.ask("remove", spawned, code=1)[0], "0 of 1 removed\n")
        self.assertIn("NO_SUCH_BODY", self.ask("push", "--body", spawned, "--velocity", "0,1,0", code=1)[0])

    def test_many_clients_get_their_frames(self):
        out, _ = self.ask("load", "--clients", 10, "--duration", "2s", "--rate", 30, "--push-rate", 100, "--json")
        load = json.loads(out)
        self.assertEqual(load["streams"], 40)
        self.assertEqual(load["failed_streams"], 0)
        self.assertGreater(load["least_frames_per_second"], 15)
        self.assertGreater(load["pushes"]["applied"], 50)

    def test_recording_replays_bit_for_bit_and_is_reported(self):
        file = self.path / "run.mcap"
        record = self.start("record", "--server", self.servers[1], "--out", file, "--duration", "4s", "--json")
        self.ask("spawn", "--shape", "sphere:0.5", "--position", "0,9,0")
        self.ask("push", "--sphere", "0,1,0,10", "--outward", "50", server=2)
        out, err = record.communicate(timeout=DEADLINE_S)
        self.assertEqual(record.returncode, 0, err)
        self.assertGreaterEqual(json.loads(out)["seconds"], 4)
        code, out, err = self.run_cli("replay", file, "--verify", "--json")
        self.assertEqual(code, 0, out + err)
        replay = json.loads(out)
        self.assertTrue(replay["equal"])
        self.assertGreater(replay["compared_states"], 200 * 10)
        code, out, err = self.run_cli("report", file, "--json")
        self.assertEqual(code, 0, err)
        self.assertEqual(len(json.loads(out)["regions"]), 4)
        svg = (self.path / "run.svg").read_text()
        for word in ("Frame time", "Dilation", "Transfers", "Energy", "region 3"):
            self.assertIn(word, svg)
        self.assertNotIn("nan", svg)
        # Cut off, it is replayed as far as it goes; with another state it differs.
        whole = file.read_bytes()
        (self.path / "cut.mcap").write_bytes(whole[:len(whole) * 9 // 10])
        code, out, err = self.run_cli("replay", self.path / "cut.mcap", "--verify")
        self.assertIn("cut off", err)
        self.assertEqual(code, 0, out + err)
        self.assertIn("equal, bit for bit", out)
        for name, text in (("not-there.mcap", None), ("text.mcap", b"no recording")):
            if text is not None:
                (self.path / name).write_bytes(text)
            for command in ("replay", "report"):
                code, _, err = self.run_cli(command, self.path / name)
                self.assertEqual(code, 2, err)
                self.assertIn(name, err)

    def test_top_and_doctor_tell_how_the_servers_do(self):
        out, _ = self.ask("top", "--duration", "2s", "--json", server=3)
        last = json.loads(out.splitlines()[-1])
        self.assertEqual([r["server"] for r in last["regions"]], self.servers)
        self.assertGreater(last["bodies"], 200)
        self.assertTrue(all(r["up"] and r["tick"] > 0 for r in last["regions"]))
        out, _ = self.ask("doctor", "--json")
        findings = json.loads(out)
        self.assertNotIn("FAILURE", [f["level"] for f in findings])
        self.assertIn("world demo on 4 region servers", [f["what"] for f in findings])
        code, out, _ = self.run_cli("doctor", "--server", "127.0.0.1:1")
        self.assertEqual(code, 1)
        self.assertIn("FAILURE", out)

    def test_top_follows_a_layout_and_a_recording_ends_where_it_changes(self):
        file = self.path / "run.mcap"
        record = self.start("record", "--server", self.servers[2], "--out", file)
        top = self.start("top", "--server", self.servers[0], "--json")
        wait_for(lambda: file.exists() and file.stat().st_size > 100_000, "the snapshots are recorded")

        def shown_until(regions):
            for line in top.stdout:
                shown = json.loads(line)["regions"]
                if len(shown) == regions and all(r["up"] and r["tick"] > 0 for r in shown):
                    return {r["server"] for r in shown}
            self.fail(f"top ended before it showed {regions} regions: {top.stderr.read()}")

        self.assertEqual(shown_until(4), set(self.servers))
        for columns, rows in ((3, 2), (2, 1)):
            code, _, err = self.run_cli("resize", "--control", self.control, "--columns", columns, "--rows", rows)
            self.assertEqual(code, 0, err)
            shown = shown_until(columns * rows)
        top.send_signal(signal.SIGINT)
        self.assertEqual(top.wait(DEADLINE_S), 0)
        out, err = record.communicate(timeout=DEADLINE_S)
        self.assertEqual(record.returncode, 1, err)
        self.assertIn("the layout of the world has changed", err)
        code, out, err = self.run_cli("replay", file, "--verify", "--json")
        self.assertEqual(code, 0, out + err)
        self.assertTrue(json.loads(out)["equal"], "what was recorded until then is whole")
        code, out, err = self.run_cli("doctor", "--server", min(shown), "--json")
        self.assertEqual(code, 0, out + err)
        findings = json.loads(out)
        self.assertNotIn("FAILURE", [f["level"] for f in findings])
        self.assertIn("world demo on 2 region servers", [f["what"] for f in findings])

    def test_bad_input_is_named(self):
        for arguments, word in ((["spawn", "--shape", "cube:1", "--position", "0,0,0"], "--shape"),
                                (["spawn", "--shape", "sphere:-1", "--position", "0,0,0"], "bodies[0].shape.sphere"),
                                (["push", "--body", "3", "--impulse", "1,2"], "--impulse"),
                                (["push", "--body", "3", "--force", "0,1,0"], ""),
                                (["push", "--sphere", "0,0,0,5"], "--impulse"),
                                (["ray", "--from", "0,0,0", "--direction", "0,0,0"], "rays[0].direction"),
                                (["watch", "--rect", "5,-5,0,1"], "rect")):
            _, err = self.ask(arguments[0], *arguments[1:], code=2)
            self.assertIn(word, err)
        code, _, err = self.run_cli("watch", "--server", "127.0.0.1:1")
        self.assertEqual(code, 2)
        self.assertIn("--server", err)


class Secured(Cli):
    def test_world_is_open_to_those_who_have_a_token_and_its_authority(self):
        certificates, tokens, token = self.path / "certificates", self.path / "tokens.json", self.path / "token"
        code, _, err = self.run_cli("certificates", certificates)
        self.assertEqual(code, 0, err)
        for secret in ("ca.key", "tls.key"):
            self.assertEqual(stat.S_IMODE((certificates / secret).stat().st_mode), 0o600)
        code, out, err = self.run_cli("token", "anna", "--world", "bridge", "--rights", "watch", "--tokens", tokens)
        self.assertEqual(code, 0, err)
        self.assertGreaterEqual(len(out.strip()), 43)  # 256 bits
        self.assertNotIn(out.strip(), tokens.read_text())
        token.write_text(out)
        code, _, err = self.run_cli("token", "bob", "--world", "bridge", "--rights", "fly", "--tokens", tokens)
        self.assertEqual(code, 2)
        self.assertIn("'fly' is no right", err)
        up = self.start("up", WORLDS / "bridge.json", "--tls", certificates, "--tokens", tokens)
        line = ""
        while not line.startswith("servers: "):
            line = up.stdout.readline()
            self.assertTrue(line, "the run ended")
        threading.Thread(target=up.stdout.read, daemon=True).start()
        server = ("--server", line.split()[1])
        tls = ("--tls-ca", certificates / "ca.crt")
        code, out, err = self.run_cli("watch", *server, *tls, "--token-file", token, "--bodies", "--json")
        self.assertEqual(code, 0, err)
        self.assertTrue(json.loads(out)["bodies"])
        code, _, err = self.run_cli("spawn", *server, *tls, "--token-file", token, "--shape", "sphere:1", "--position", "0,9,0")
        self.assertEqual(code, 1)
        self.assertIn("NO_RIGHT", err)
        code, _, err = self.run_cli("watch", *server, *tls)
        self.assertEqual(code, 2)
        self.assertIn("NO_TOKEN", err)
        code, _, err = self.run_cli("watch", *server, "--token-file", token)
        self.assertEqual(code, 2)
        self.assertIn("--tls-ca", err)
        up.send_signal(signal.SIGINT)
        self.assertEqual(up.wait(DEADLINE_S), 0)

    def test_servers_do_not_listen_in_plain_text_beyond_this_machine(self):
        commands = (["aureole-region", "--control", "127.0.0.1:1", "--listen", "0.0.0.0:0"],
                    ["aureole-control", WORLDS / "bridge.json", "--listen", "0.0.0.0:0"])
        for name, *flags in commands:
            done = subprocess.run([BIN / name, *flags], capture_output=True, text=True, timeout=DEADLINE_S)
            self.assertEqual(done.returncode, 1, done.stderr)
            self.assertIn("--listen: 0.0.0.0:0 is not of this machine only", done.stderr)
            self.assertIn("--insecure", done.stderr)


class Results(Cli):
    def test_json_is_all_of_the_output(self):
        code, out, err = self.run_cli("up", WORLDS / "demo.json", "--duration", "10s", "--no-real-time", "--json",
                                      *self.fake())
        self.assertEqual((code, err), (0, ""))
        result = json.loads(out)
        self.assertTrue(result["ok"])
        self.assertEqual((result["tick"], result["bodies"], len(result["regions"])), (625, 120, 4))
        self.assertEqual([h["tick"] for h in result["hashes"]], [100, 200, 300, 400, 500, 600, 625])

    def test_control_plane_of_its_own_runs_a_world(self):
        process = subprocess.run([BIN / "aureole-control", WORLDS / "demo.json", "--duration", "10s", "--no-real-time",
                                  *self.fake()], capture_output=True, text=True, timeout=DEADLINE_S,
                                 env={**os.environ, "TMPDIR": self.directory.name})
        self.assertEqual(process.returncode, 0, process.stderr)
        self.assertIn("[control] finished, 4 regions", process.stderr)
        self.assertIn("[control] 625 ticks, 120 bodies", process.stderr)

    def test_interrupted_before_the_end_is_said(self):
        process = self.start("up", WORLDS / "demo.json", "--duration", "60s", *self.fake())
        wait_for(lambda: "tick" in process.stdout.readline(), "a tick")
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
        self.assertEqual(process.returncode, 130)

    def experiment(self, flags=""):
        return self.run_cli("experiment", WORLDS / "paper" / "column-1.json", WORLDS / "paper" / "column-4.json",
                            WORLDS / "paper" / "corner-4.json", "--duration", "10s", "--no-real-time", "--out",
                            self.path / "out", *self.fake(flags))

    def test_experiment_writes_its_files(self):
        code, out, err = self.experiment()
        self.assertEqual(code, 0, err)
        self.assertIn("column-4", out)
        self.assertEqual(sorted(p.name for p in (self.path / "out").iterdir()),
                         ["columns.svg", "corners.svg", "experiment.csv", "experiment.json"])
        result = json.loads((self.path / "out" / "experiment.json").read_text())
        self.assertEqual([r["world"] for r in result["runs"]], ["column-1", "column-4", "corner-4"])
        for run in result["runs"]:
            self.assertTrue(run["hash_equal"], run)
            self.assertEqual((run["lost"], run["doubled"], run["violations"]), (0, 0, 0))
            self.assertEqual(len(run["windows"]), 2)

    def test_experiment_that_is_not_exact_fails_and_says_where(self):
        code, out, err = self.experiment("--wrong-hash --fail-region 1")
        self.assertEqual(code, 1)
        self.assertIn("column-4: differs from the undivided run, first at tick 200", out)
        code, out, err = self.experiment("--lose-at 300 --fail-region 1")
        self.assertEqual(code, 1)
        runs = json.loads((self.path / "out" / "experiment.json").read_text())["runs"]
        self.assertEqual([r["lost"] for r in runs], [0, 1, 1])

    def test_policies_are_compared_in_every_crowd(self):
        code, out, err = self.run_cli("experiment", "--policies", "--duration", "1s", "--json", "--out",
                                      self.path / "out", *self.fake())
        self.assertEqual(code, 0, err)
        self.assertEqual(sorted(p.name for p in (self.path / "out").iterdir()), ["policies.csv", "policies.json"])
        result = json.loads(out)
        self.assertEqual(result, json.loads((self.path / "out" / "policies.json").read_text()))
        self.assertEqual([(s["kicks"], s["density"]) for s in result["scenes"]],
                         [(k, d) for k in ("slow", "fast") for d in (0.05, 0.2, 0.5, 1)])
        for scene in result["scenes"]:
            self.assertEqual([(r["policy"], r["exchange_delay"]) for r in scene["runs"]],
                             [(None, 0), ("reach", 1), ("reach", 2), ("tolerance", 1), ("tolerance", 2)])
            self.assertTrue(all(r["hash_equal"] for r in scene["runs"]), scene)

    def test_interrupted_experiment_leaves_no_server(self):
        process = self.start("experiment", WORLDS / "paper" / "column-4.json", "--out", self.path / "out",
                             *self.fake())
        servers = self.servers_of(process, 1)  # the undivided run comes first
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
        self.assertEqual(process.returncode, 130)
        self.assert_gone(servers)


class Exactness(Cli):
    """With real region servers."""

    def hashes(self, world, *flags):
        code, out, err = self.run_cli("up", WORLDS / world, "--duration", "5s", "--no-real-time", "--json",
                                      "--hash-every", "25", *flags)
        self.assertEqual(code, 0, err)
        result = json.loads(out)
        self.assertEqual(result["violations"], 0)
        return result["hashes"], result["transfers"]

    def test_split_world_is_the_undivided_one(self):
        for world in ("border-pile.json", "demo.json"):
            split, transfers = self.hashes(world)
            undivided, none = self.hashes(world, "--undivided")
            self.assertEqual(split, undivided)
            self.assertEqual(len(split), 13)
            self.assertGreater(transfers, 0)
            self.assertEqual(none, 0)

    def test_stopped_server_is_waited_for_by_name_and_changes_nothing(self):
        expected, _ = self.hashes("border-pile.json")
        process = self.start("up", WORLDS / "border-pile.json", "--duration", "5s", "--hash-every", "25",
                             "--logs", self.path / "logs")
        servers = self.servers_of(process, 2)
        wait_for(lambda: "tick" in process.stdout.readline(), "a tick")
        os.kill(servers[1], signal.SIGSTOP)
        wait_for(lambda: "region 0 waits for region 1" in process.stdout.readline(), "the wait")
        wait_for(lambda: "nothing heard of region 1 for" in process.stdout.readline(), "the silence")
        os.kill(servers[1], signal.SIGCONT)
        out, err = process.communicate(timeout=DEADLINE_S)
        self.assertEqual(process.returncode, 0, err)
        self.assertIn(f"state hash {expected[-1]['hash']} at tick {expected[-1]['tick']}", out)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
