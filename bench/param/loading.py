"""A dump for a device: what differs, and whether it may be written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bench.errors import BenchError
from bench.param import history
from bench.param.differences import Differences, compare
from bench.param.dump import Dump
from bench.param.table import Parameters
from protocol.signals import Flag


@dataclass(frozen=True)
class Load:
    """What a dump would change in a device. `differences.a` is the file, `differences.b` the device."""

    dump: Dump
    device: Parameters
    differences: Differences
    of_another: tuple[str, ...]
    """Parameters of calibration among the differences, where the dump is of another device."""

    @property
    def wanted(self) -> dict[str, float]:
        """What has to be written, in the device's order."""
        new = {difference.name: difference.a for difference in self.differences.values}
        return {name: new[name] for name in self.device if name in new}

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names in the file that the device does not have."""
        return self.differences.only_a

    @property
    def agrees(self) -> bool:
        """Whether the device has all that the file says."""
        return not self.differences.values and not self.unknown

    def remarks(self) -> list[str]:
        """What a person should know before it is written."""
        said = []
        if self.unknown:
            said.append(f"{self.device.title} does not have {', '.join(self.unknown)}: left out")
        if self.differences.only_b:
            said.append(f"{self.dump.path} does not have {', '.join(self.differences.only_b)}: left as they are")
        return said


def prepare(dump: Dump, device: Parameters, groups: Sequence[str] = ()) -> Load:
    """Compare a dump with a device, as far as it can be loaded; `groups`: only these."""
    known = history.read(device)
    number = int(device.identity.get("node", 1))

    def loadable(side: Parameters) -> Parameters:
        out = {name for each in (dump.parameters, device) for name, e in each.entries.items() if not e.loadable}
        kept = {name: entry for name, entry in side.entries.items() if name not in out}
        return Parameters(side.title, kept, side.identity)

    differences = compare(
        loadable(dump.parameters), loadable(device), groups, lambda name, a, b: known.rounds(number, name, a, b)
    )
    another = not device.serial or dump.parameters.serial != device.serial
    calibration = tuple(
        d.name for d in differences.values if another and device.entries[d.name].flags & Flag.CALIBRATION
    )
    return Load(dump, device, differences, calibration)


def require_own(load: Load) -> None:
    """Raise BenchError where calibration of another device would be written."""
    if load.of_another:
        whose = load.dump.parameters.serial or "without a serial number"
        raise BenchError(
            f"{load.dump.path} is of device {whose}, this is {load.device.serial or 'one without a serial number'}: "
            f"{', '.join(load.of_another)} go with the motor and its sensors; --other-drive loads them all the same, "
            "--group identity, tuning or limits leaves them out"
        )
