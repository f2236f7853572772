"""What the tests of checkpoints have in common: loading an agent of the point mass, and changing its file."""

import zipfile

import numpy as np

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.checkpoints.format import Checkpoint, read_checkpoint, write_checkpoint
from tests.agents.point_mass import KnownPointMass, LinearModel, planner

OBSERVATIONS = np.random.default_rng(0).normal(size=(4, 2))


def load(path, env=None, **arguments):
    env = KnownPointMass(fixed_start=True) if env is None else env
    return MPCAgent.load(path, env=env, dynamics=LinearModel(), planner=planner(), **arguments)


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def changed(saved, path, change):
    """The saved file with its config edited, checksums right."""
    config, tensors, _ = read_checkpoint(saved)
    change(config, tensors)
    write_checkpoint(Checkpoint(config, tensors), path)
    return path
