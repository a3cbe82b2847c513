"""The memory of a keeper after some snapshots, for other tests."""

from dataclasses import replace

import imgcal
from imgcal.association import PipelineOptions
from imgcal.detection import DetectionOptions
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.labelling import Labelling
from imgcal.online.snapshot_labels import Labelled, label_snapshot
from imgcal.online.snapshot_update import learn_snapshot
from imgcal.types import Detections
from scripts.benchmarks.rig_streams import Conditions, Stream

OPTIONS = PipelineOptions(blind_cameras=True)


class Remembered:
    """A stream whose snapshots are labelled and learnt, and nothing else."""

    def __init__(self, seed: int = 1, **given) -> None:
        obj = imgcal.load_object("asymmetric8")
        self.stream = Stream(imgcal.load_rig("T4"), obj, seed, given.pop("conditions", Conditions()), **given)
        self.memory = KeeperMemory.from_factory(self.stream.factory, obj, None, OPTIONS)
        self.labelling = Labelling(self.memory.factory, obj, OPTIONS, DetectionOptions(), "classical")

    def blobs(self) -> Detections:
        """The next snapshot."""
        blobs = self.stream.snapshot(self.memory.count)
        self.memory.time = self.memory.count / self.stream.conditions.rate
        self.memory.count += 1
        return replace(blobs, snapshot_names=("next",))

    def labelled(self, blobs: Detections) -> Labelled:
        return label_snapshot(self.memory, self.labelling, blobs, "next", None)

    def learn(self, count: int) -> KeeperMemory:
        """Learn so many snapshots."""
        for _ in range(count):
            learn_snapshot(self.memory, self.labelled(self.blobs()).checked)
            self.labelling.follow(self.memory.poses[-1][1][0])
        return self.memory
