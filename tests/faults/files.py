"""Agents' files that were mutated, and such that someone made to harm: only named errors, no code run, little memory.

Runs in a forked child whose address space is bounded, so that what takes more memory than it may is an error.
"""

import builtins
import hashlib
import io
import json
import os
import pickle
import random
import resource
import struct
import sys
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save as save_tensors

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.checkpoints.format import SCHEMA, read_checkpoint
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.randomness import Generators
from tests.faults.kills import TINY
from tests.runs.toy import EPISODE_STEPS

MEMORY_BOUND = 64 << 20
"""Bytes of Python objects that reading one of these files may allocate at its peak; the files have some 50 kB."""
OLDER = Path(__file__).parents[1] / "checkpoints" / "files"
"""Files of older schemas."""
ADDRESS_SPACE = 2 << 30
"""Bytes by which the process may grow, tensors included."""


def an_agent(path):
    """A small agent that has learned, saved."""
    agent = DGPMPCAgent("ToyPush-v0", seed=0, **TINY).learn(2 * EPISODE_STEPS + 5)
    agent.save(path)
    return agent


def members_of(data):
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(members, schema=SCHEMA, **options):
    """A zip of these members with a manifest that fits them, so that checks beyond the checksums are reached."""
    members = {name: data for name, data in members.items() if name != "manifest.json"}
    table = {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in members.items()}
    manifest = {"format": "gym_dgpmpc agent", "schema": schema, "members": table}
    return raw_zip({**members, "manifest.json": json.dumps(manifest).encode()}, **options)


def raw_zip(members, **options):
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with zipfile.ZipFile(buffer, "w", **options) as archive:
            for name, data in members.items() if isinstance(members, dict) else members:
                archive.writestr(name, data)
    return buffer.getvalue()


def mutated(rng, data):
    """The file with something changed: bytes of the file itself, or, behind right checksums, of what it holds."""
    kind = rng.randrange(7)
    if kind == 0:
        return flipped(rng, data, rng.choice([1, 1, 4, 64]))
    if kind == 1:
        return data[: rng.randrange(len(data))]
    if kind == 2:
        place, length = rng.randrange(len(data)), rng.randrange(1, 200)
        return data[:place] + rng.choice([b"", rng.randbytes(length), data[place : place + length] * 2]) + data[place:]
    if kind == 3:
        place = rng.randrange(len(data))
        return data[:place] + data[place + rng.randrange(1, 200) :]
    members = members_of(data)
    schema = json.loads(members["manifest.json"])["schema"]
    name = rng.choice([name for name in members if name != "manifest.json"])
    if kind == 4:
        members[name] = flipped(rng, members[name], rng.choice([1, 1, 8]))
    elif kind == 5 and name.endswith(".safetensors"):
        members[name] = _other_header(rng, members[name])
    else:
        config = json.loads(members["config.json"])
        _change_something(rng, config)
        members["config.json"] = json.dumps(config).encode()
    return zipped(members, schema)


def flipped(rng, data, count):
    data = bytearray(data)
    for _ in range(count):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data)


def _other_header(rng, data):
    """A safetensors member with its header changed."""
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    _change_something(rng, header)
    text = json.dumps(header).encode()
    return struct.pack("<Q", rng.choice([len(text), len(text) + 1, size])) + text + data[8 + size :]


ODD_VALUES = (
    None,
    True,
    -1,
    0,
    1,
    7,
    10**6,
    10**9,
    2**63,
    10**30,
    0.5,
    -1e300,
    "",
    "x",
    "rbf",
    "F64",
    [],
    [1],
    {},
    "é",
)


def _change_something(rng, value):
    """Replace, remove, add or repeat something, at a random place of nested plain values."""
    while True:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        if not keys:
            return
        key = rng.choice(keys)
        if isinstance(value[key], dict | list) and value[key] and rng.random() < 0.8:
            value = value[key]
            continue
        change = rng.randrange(4)
        if change == 0:
            del value[key]
        elif change == 1 and isinstance(value, dict):
            value[rng.choice(["new", "../x", key + "x"])] = rng.choice(ODD_VALUES)
        else:
            value[key] = rng.choice(ODD_VALUES)
        return


class Harm:
    """What runs when a pickle of it is read."""

    def __reduce__(self):
        return os.putenv, ("THE_FILE_RAN_CODE", "1")


def hostile_files(data):
    """Name -> bytes of files made to run code, to fill the memory, or to write elsewhere."""
    members = members_of(data)
    config = json.loads(members["config.json"])
    older = members_of((OLDER / "schema3.zip").read_bytes())
    old_config = json.loads(older["config.json"])
    harm = pickle.dumps(Harm())
    legacy = io.BytesIO()
    torch.save({"policy": Harm()}, legacy)

    def with_config(**changes):
        return zipped({**members, "config.json": json.dumps(config | changes).encode()})

    def with_arguments(**changes):
        return with_config(arguments=config["arguments"] | changes)

    def with_member(name, content, **options):
        return zipped({**members, name: content}, **options)

    def header(table, body=b"", size=None):
        text = json.dumps(table).encode() if isinstance(table, dict) else table
        return struct.pack("<Q", len(text) if size is None else size) + text + body

    def tensor(dtype="F64", shape=(1,), offsets=(0, 8), body=bytes(8)):
        table = {"x": {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)}}
        return with_member("dynamics.safetensors", header(table, body))

    def with_old_config(**changes):
        return zipped({**older, "config.json": json.dumps(old_config | changes).encode()}, schema=3)

    def with_values(noun, **changes):
        return with_config(values=config["values"] | {noun: config["values"][noun] | changes})

    def with_tensors(part, **tensors):
        return with_member(f"{part}.safetensors", save_tensors(tensors))

    end = data.rindex(b"PK\x05\x06")

    def with_end(**fields):
        values = list(struct.unpack("<4s4H2LH", data[end:]))
        for name, value in fields.items():
            values[("sign", "disk", "start", "here", "total", "size", "offset", "comment").index(name)] = value
        return data[:end] + struct.pack("<4s4H2LH", *values)

    huge = "9" * 3_000_000
    files = {
        "a pickle": harm,
        "a pickle of protocol 0": pickle.dumps(Harm(), 0),
        "a file of torch.save": legacy.getvalue(),
        "an SB3 file": raw_zip({"data": b"{}", "policy.pth": harm, "_stable_baselines3_version": b"2"}),
        "a pickle as plain values": with_member("config.json", harm),
        "a pickle as tensors": with_member("dynamics.safetensors", harm),
        "a pickle beside the tensors": with_member("dynamics.pkl", harm),
        "a pickle as the manifest": raw_zip({**members, "manifest.json": harm}),
        "SB3's serialised data": with_config(**{":type:": "<class>", ":serialized:": "gASV"}),
        "another class": with_config(**{"class": "os.system"}),
        "a module's path as class": with_config(**{"class": "../../evil"}),
        "a class of builtins": with_config(**{"class": "eval"}),
        "an environment as argument": with_arguments(env="evil:Env-v0"),
        "a function as argument": with_arguments(reward_fn="os.system"),
        "code as kernel": with_arguments(kernel="__import__('os').putenv('THE_FILE_RAN_CODE', '1')"),
        "a path as log folder of a number": with_arguments(tensorboard_log=3),
        "more candidates than memory": with_arguments(num_candidates=10**9),
        "more states than memory": with_arguments(num_candidates=10**5, num_particles=10**4),
        "a horizon beyond memory": with_arguments(horizon=10**7),
        "layers beyond memory": with_arguments(num_layers=10**7),
        "features beyond memory": with_arguments(num_features=10**7),
        "inducing points beyond memory": with_arguments(num_inducing=10**7),
        "a planner that is no name": with_arguments(planner=["cem"]),
        "an unknown planner": with_arguments(planner="os.system"),
        "a list as limit": with_arguments(num_layers=[10**9]),
        "environments beyond memory": with_config(num_envs=10**9),
        "an unknown noun": with_config(values=config["values"] | {"evil": {}}),
        "a list of nouns": with_config(values=[1, {}]),
        "a noun that is a number": with_config(values=config["values"] | {"task": 3}),
        "a number that is none": with_values("progress", num_timesteps={"float": "evil"}),
        "a counter beyond counting": with_values("progress", num_timesteps=10**300),
        "infinite numbers of episodes": with_values("progress", num_episodes={"float": "inf"}),
        "an index of no episode": with_values("episodes", **{"0.index": -(10**9)}),
        "a planner that is another": with_values("episodes", planner={"class": "evil", "fields": {}}),
        "junk about the environment": with_values("task", about_environment={"environment": [{}], "reset_options": 3}),
        "nested junk about the environment": with_values("task", about_environment={"observation_parts": [[{}]]}),
        "junk to learn": with_values("task", to_learn={"reward_fn": {"reward_fn": True}, "evil": True}),
        "logs in another folder": with_values("logs", run="../../evil"),
        "logs of no weight": with_values("logs", waiting=[["a", 1.0, -1, None]]),
        "logs in no format": with_values("logs", waiting=[["a", 1.0, 0, 7]]),
        "plain values in place of tensors": with_values("transitions", reward=[0.0] * 10**5),
        "many names in an old file": with_old_config(episode_infos=[{f"{i}": 1} for i in range(10**5)]),
        "many episodes in an old file": with_old_config(running=[{"index": 0, "has_explored": True}] * 30_000),
        "a number of 3 million digits": with_member("config.json", b'{"class": ' + huge.encode() + b"}"),
        "infinity": with_member("config.json", b'{"class": Infinity}'),
        "deep lists": with_member("config.json", b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
        "deep objects": with_member("config.json", b'{"a": ' * 50_000 + b"1" + b"}" * 50_000),
        "many empty lists": with_member("config.json", b'{"a": [' + b"[]," * 660_000 + b"1]}"),
        "repeated names": with_member("config.json", b'{"class": "DGPMPCAgent", "class": "MPCAgent"}'),
        "plain values of 8 MB": with_member("config.json", json.dumps(config | {"x": "y" * (8 << 20)}).encode()),
        "a list as plain values": with_member("config.json", b"[1]"),
        "a zip bomb": with_member("dynamics.safetensors", bytes(64 << 20), compression=zipfile.ZIP_DEFLATED),
        "a zip bomb of JSON": with_member("config.json", b" " * (64 << 20) + b"{}", compression=zipfile.ZIP_LZMA),
        "overlapping members": overlapping(members["transitions.safetensors"]),
        "10,000 members": raw_zip({f"{i}": b"" for i in range(10_000)}),
        "a table of 4 GB": with_end(size=2**32 - 2),
        "60,000 members in the table": with_end(here=60_000, total=60_000),
        "a 64-bit table": data[:end] + struct.pack("<4sLQL", b"PK\x06\x07", 0, 0, 1) + data[end:],
        "a comment": data[:-2] + struct.pack("<H", 60_000) + bytes(60_000),
        "repeated members": raw_zip([*members.items(), ("config.json", b"{}")]),
        "path traversal": with_member("../../evil.safetensors", save_tensors({"x": torch.zeros(1)})),
        "an absolute path": with_member("/tmp/evil.safetensors", save_tensors({"x": torch.zeros(1)})),
        "a header beyond the file": with_member("dynamics.safetensors", header({}, size=2**63)),
        "a header of 100 MB": with_member("dynamics.safetensors", header({}, size=100 << 20)),
        "a tensor beyond the file": tensor(shape=(2**40,), offsets=(0, 2**43)),
        "a shape that overflows": tensor(shape=(2**33, 2**33, 2), offsets=(0, 8)),
        "a negative shape": tensor(shape=(-1,), offsets=(0, 8)),
        "tensors that overlap": with_member(
            "dynamics.safetensors",
            header({n: {"dtype": "F64", "shape": [1], "data_offsets": [0, 8]} for n in "xy"}, bytes(8)),
        ),
        "an unknown kind of tensor": tensor(dtype="PICKLE"),
        "a tensor of no size": tensor(shape=(0, 2**61), offsets=(0, 0), body=b""),
        "transitions of another kind": with_tensors("transitions", reward=torch.zeros(3, dtype=torch.int64)),
        "generators of another kind": with_tensors(
            "random", **{name: torch.zeros(5056, dtype=torch.float64) for name in Generators._fields}
        ),
        "generators of random bytes": with_tensors(
            "random",
            **{
                name: torch.randint(256, (5056,), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
                for name in Generators._fields
            },
        ),
        "no tensors at all": with_tensors("episodes"),
        "a FIFO": None,
        "a folder": None,
    }
    return files


def overlapping(content):
    """A zip whose 40 members are one and the same content."""
    one = raw_zip({"a.safetensors": content})
    end = one.rindex(b"PK\x05\x06")
    start = one.index(b"PK\x01\x02")
    entry = one[start:end]
    entries = b"".join(entry.replace(b"a.safetensors", b"%c.safetensors" % (65 + i)) for i in range(40))
    return one[:start] + entries + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 40, 40, len(entries), start, 0)


def attempt(path, observation):
    """Load a file and predict with the agent: ("loaded" or a named error, what was wrong)."""
    try:
        agent = DGPMPCAgent.load(path, env="ToyPush-v0")
        action, _ = agent.predict(observation)
        if not (np.isfinite(action).all() and agent.action_space.contains(action)):
            return "loaded", f"the action {action}"
        return "loaded", None
    except DGPMPCError as error:
        return type(error).__name__, None
    except OSError as error:
        return "OSError", None if not isinstance(path, Path) or path.is_dir() else f"{error!r}"
    except BaseException as error:
        return type(error).__name__, f"{type(error).__name__}: {error}"


def watch_for_code():
    """Opening for writing, starting processes and importing what is new, all noted, as audit events."""
    noted = []

    def hook(event, arguments):
        if event == "marshal.loads" and _is_import_of_the_shape_checker(sys._getframe(1)):
            return
        if event in ("os.system", "subprocess.Popen", "os.exec", "os.putenv", "pickle.find_class", "marshal.loads"):
            noted.append(f"{event}{arguments}")
        elif event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+"):
            noted.append(f"open{arguments[:2]}")

    sys.addaudithook(hook)
    return noted


def _is_import_of_the_shape_checker(frame):
    """Whether Python loads a module of what checks shapes under the tests, which imports its error messages late."""
    name = str(frame.f_locals.get("name"))
    is_import = frame.f_code.co_filename == "<frozen importlib._bootstrap_external>"
    return is_import and name.split(".")[0] in ("beartype", "jaxtyping", "wadler_lindig")


def run_in_child(work):
    """The JSON value that ``work`` returns in a forked child whose memory is bounded."""
    reading, writing = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if not child:
        status = 1
        try:
            os.close(reading)
            held = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (held + ADDRESS_SPACE, held + ADDRESS_SPACE))
            with os.fdopen(writing, "wb") as file:
                file.write(json.dumps(work()).encode())
            status = 0
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        answer = file.read()
    _, status = os.waitpid(child, 0)
    if status:
        return {"counts": {}, "wrong": [f"the process that read the files ended with status {status}"]}
    return json.loads(answer)


def try_files(files, folder, observation):
    """Counts of outcomes, and what was wrong, over (name, bytes) pairs; for `run_in_child`."""
    warnings.simplefilter("ignore")
    noted, counts, wrong = watch_for_code(), {}, []
    path = Path(folder) / "file.zip"
    for name, content in files:
        if content is not None:
            path.write_bytes(content)
        target = path if content is not None else Path(folder) / name
        noted.clear()
        tracemalloc.start()
        outcome, fault = attempt(target, observation)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        counts[outcome] = counts.get(outcome, 0) + 1
        if fault:
            wrong.append(f"{name}: {fault}")
        if noted or os.environ.get("THE_FILE_RAN_CODE") or hasattr(builtins, "evil"):
            wrong.append(f"{name}: it did {noted}")
        if peak > MEMORY_BOUND + 4 * len(content or b""):
            wrong.append(f"{name}: {peak >> 20} MB of memory")
    return {"counts": counts, "wrong": wrong}


def run_mutations(folder, number, seed=0):
    """Read ``number`` mutated files, every fourth of an older schema: ({outcome: count}, what was wrong)."""
    folder = Path(folder) / "mutations"
    folder.mkdir(parents=True)
    agent = an_agent(folder / "agent.zip")
    assert read_checkpoint(folder / "agent.zip")  # zipfile imports an encoding with the first name that it reads
    present = (folder / "agent.zip").read_bytes()
    older = [path.read_bytes() for path in sorted(OLDER.glob("schema*.zip"))]
    observation = agent.store.transitions().observation[0].numpy()
    rng = random.Random(seed)
    files = (
        (f"mutation {i}", mutated(rng, older[i // 4 % len(older)] if i % 4 == 3 else present)) for i in range(number)
    )
    result = run_in_child(lambda: try_files(files, folder, observation))
    return result["counts"], result["wrong"]


def run_hostile(folder):
    """Read the hostile files: (number, {outcome: count}, what was wrong)."""
    folder = Path(folder) / "hostile"
    folder.mkdir(parents=True)
    agent = an_agent(folder / "agent.zip")
    files = hostile_files((folder / "agent.zip").read_bytes())
    os.mkfifo(folder / "a FIFO")
    (folder / "a folder").mkdir()
    observation = agent.store.transitions().observation[0].numpy()
    result = run_in_child(lambda: try_files(files.items(), folder, observation))
    assert read_checkpoint(folder / "agent.zip")
    return len(files), result["counts"], result["wrong"]
