"""Cables and hosts fail: every fault ends in a retry that the pictures survive, or in a clear state."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest
import usb.core
from plugged import WINDOW, Plugged

from endo3d.services.devices.dlp_link import ATTEMPTS, DeviceGone, Link, Rejected
from endo3d.services.devices.emulated.usb_port import Fault, UsbPort
from endo3d.services.devices.uri import DeviceError
from endo3d_core import patterns

INTERLEAVED = patterns.parse("interleaved f1=25")
CONVENTIONAL = patterns.parse("conventional f=50/49/43 steps=4/2/2")
PASSING: tuple[Fault, ...] = ("timeout", "stall", "short read", "wrong sequence")


def assert_shown(plugged: Plugged, pattern_set: patterns.PatternSet) -> None:
    """The last show is this set, bit for bit."""
    shown = plugged.shows[-1].patterns
    assert len(shown) == len(pattern_set)
    for each, pattern in zip(shown, pattern_set.patterns, strict=True):
        (height, width), (w, h) = each.pixels.shape, WINDOW
        top, left = (height - h) // 2, (width - w) // 2
        inside = each.pixels[top : top + h, left : left + w]
        np.testing.assert_array_equal(inside, patterns.image(pattern, *WINDOW))


@pytest.fixture
def running(plugged: Plugged) -> Plugged:
    plugged.projector.load([INTERLEAVED, CONVENTIONAL])
    plugged.projector.start(INTERLEAVED, 7471.0, 105.0)
    return plugged


class TestPassingFaults:
    @pytest.mark.parametrize("fault", PASSING)
    @pytest.mark.parametrize("times", [1, ATTEMPTS - 1])
    def test_a_command_is_repeated(self, running: Plugged, fault: Fault, times: int) -> None:
        running.port.fail_next(*[fault] * times)
        assert running.projector.status().running
        running.port.fail_next(*[fault] * times)
        running.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert_shown(running, CONVENTIONAL)

    @pytest.mark.parametrize("seed", range(4))
    def test_an_upload_over_a_bad_cable_is_bit_exact(self, plugged: Plugged, seed: int) -> None:
        """About every 20th transfer fails somehow; never so often in a row that the driver gives up."""
        rng = random.Random(seed)
        failing = FailingSometimes(plugged.port, rng)
        plugged.projector.load([INTERLEAVED, CONVENTIONAL])
        plugged.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert failing.failed > 20
        assert_shown(plugged, CONVENTIONAL)

    @pytest.mark.parametrize("fault", ["timeout", "short read", "wrong sequence"])
    def test_a_device_that_stays_mute_is_named(self, running: Plugged, fault: Fault) -> None:
        running.port.fail_next(*[fault] * 40)
        with pytest.raises(DeviceError, match="does not answer command"):
            running.projector.start(CONVENTIONAL, 7471.0, 105.0)


class FailingSometimes:
    """Queues a fault before about every 20th transfer."""

    def __init__(self, port: UsbPort, rng: random.Random) -> None:
        self.failed = 0
        write, read = port.intr_write, port.intr_read

        def fails(faults: tuple[Fault, ...]) -> None:
            if rng.random() < 0.05:
                port.fail_next(rng.choice(faults))
                self.failed += 1

        def failing_write(*arguments: object) -> int:
            fails(("timeout", "stall"))
            return write(*arguments)  # type: ignore[arg-type]

        def failing_read(*arguments: object) -> int:
            fails(PASSING)
            return read(*arguments)  # type: ignore[arg-type]

        port.intr_write, port.intr_read = failing_write, failing_read  # type: ignore[method-assign]


class TestRefusals:
    def test_the_devices_own_text_comes_back(self, plugged: Plugged) -> None:
        link = Link(plugged.find, "projector")
        with pytest.raises(Rejected, match="1A34 with error 5, not allowed in this mode") as refusal:
            link.write(0x1A34, bytes(12))
        assert refusal.value.code == 5

    def test_an_unknown_read(self, plugged: Plugged) -> None:
        with pytest.raises(Rejected, match="bad command"):
            Link(plugged.find, "projector").read(0x4242)

    def test_a_refused_part_of_an_image(self, plugged: Plugged) -> None:
        link = Link(plugged.find, "projector")
        with pytest.raises(Rejected, match="1A2B with error 11"):
            link.write(0x1A2B, bytes([100, 0]) + bytes(100))

    def test_after_a_refusal_it_goes_on(self, running: Plugged) -> None:
        with pytest.raises(DeviceError):
            running.projector.start(INTERLEAVED, 100.0, 105.0)
        running.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert_shown(running, CONVENTIONAL)

    def test_faults_of_the_hardware_are_told(self, running: Plugged) -> None:
        running.port.device.faults = 0x80
        assert "sequencer reports an error" in running.projector.status().note


class TestUnplugging:
    def test_a_clear_state(self, running: Plugged) -> None:
        running.port.unplug()
        for _ in range(2):
            status = running.projector.status()
            assert not status.connected
            assert not status.running
            assert "plug it in" in status.note
        with pytest.raises(DeviceGone):
            running.projector.start(INTERLEAVED, 7471.0, 105.0)

    def test_plugged_in_again_it_resumes(self, running: Plugged) -> None:
        running.port.unplug()
        assert not running.projector.status().connected
        running.port.plug_in()
        status = running.projector.status()
        assert status.connected
        assert not status.running
        running.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert_shown(running, CONVENTIONAL)
        assert running.projector.status().running

    def test_unnoticed_between_two_commands(self, running: Plugged) -> None:
        running.port.unplug()
        running.port.plug_in()
        with pytest.raises(DeviceGone):
            running.projector.start(CONVENTIONAL, 7471.0, 105.0)  # the old handle is dead
        running.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert_shown(running, CONVENTIONAL)

    def test_a_controller_that_lost_its_memory_is_loaded_again(self, running: Plugged) -> None:
        """A power cut too short to be seen on USB."""
        Link(running.find, "projector").write(0x0200, b"\2")
        assert not running.projector.status().running
        running.projector.start(INTERLEAVED, 7471.0, 105.0)
        assert_shown(running, INTERLEAVED)

    @pytest.mark.parametrize("transfers", [0, 1, 2, 17, 60, 200])
    def test_at_any_moment_of_an_upload(self, plugged: Plugged, transfers: int) -> None:
        """Unplugged after so many transfers of an upload; after that a start does all of it again."""
        count = itertools.count()
        write = plugged.port.intr_write

        def until_unplugged(*arguments: object) -> int:
            if next(count) == transfers:
                plugged.port.fail_next("unplug")
            return write(*arguments)  # type: ignore[arg-type]

        plugged.port.intr_write = until_unplugged  # type: ignore[method-assign]
        with pytest.raises(DeviceGone):
            plugged.projector.load([CONVENTIONAL])
        assert not plugged.projector.status().connected
        plugged.port.plug_in()
        plugged.projector.load([CONVENTIONAL])
        plugged.projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert_shown(plugged, CONVENTIONAL)

    def test_none_there_at_the_start(self) -> None:
        port = UsbPort()
        port.unplug()
        with pytest.raises(DeviceGone, match="plug it in"):
            Link(lambda: usb.core.find(backend=port, idVendor=0x0451, idProduct=0xC900), "DLPC900 projector")

    def test_usbhid_is_detached(self) -> None:
        plugged = Plugged()
        assert not plugged.port.kernel_driver
        assert plugged.port.claimed
        plugged.projector.close()
        assert not plugged.port.claimed
