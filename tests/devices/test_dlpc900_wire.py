"""The DLPC900 driver's bytes against TI's DLPU018, and its upload read back by the emulated controller."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from plugged import WINDOW, Plugged

from endo3d.services.devices.dlp_link import messages
from endo3d.services.devices.dlpc900_controller import TriggerOut
from endo3d.services.devices.dlpc900_image import HEADER_BYTES, Place, encode, pack, places, upload
from endo3d.services.devices.dlpc900_lut import Entry
from endo3d.services.devices.dlpc900_projector import Dlpc900Projector
from endo3d.services.devices.emulated.dlpc900_images import bit_plane, decode_words
from endo3d_core import patterns

INTERLEAVED = patterns.parse("interleaved f1=25")
CONVENTIONAL = patterns.parse("conventional f=50/49/43 steps=4/2/2")


def pixels_of(words: np.ndarray) -> np.ndarray:
    """(h, w) 24-bit words -> (h, w, 3), most significant byte first."""
    return np.stack([words >> 16 & 255, words >> 8 & 255, words & 255], axis=-1).astype(np.uint8)


def commands(reports: list[bytes]) -> list[tuple[int, int, bytes]]:
    """Flag, command and payload of each message in a stream of reports."""
    found = []
    stream = iter(reports)
    for report in stream:
        flag, _, length = struct.unpack_from("<BBH", report)
        message = report[4:]
        while len(message) < length:
            message += next(stream)
        found.append((flag, struct.unpack_from("<H", message)[0], message[2:length]))
    return found


class TestFraming:
    def test_a_short_write(self) -> None:
        (report,) = messages(0x40, 7, 0x1A24, b"\x02")
        assert report == bytes.fromhex("40 07 0300 241a 02") + bytes(57)

    def test_a_read(self) -> None:
        (report,) = messages(0xC0, 255, 0x0100, b"")
        assert report == bytes.fromhex("c0 ff 0200 0001") + bytes(58)

    @pytest.mark.parametrize(("payload", "reports"), [(58, 1), (59, 2), (122, 2), (123, 3), (506, 8)])
    def test_58_bytes_fit_into_the_first_report_and_64_into_the_others(self, payload: int, reports: int) -> None:
        data = bytes(range(1, 255)) * 2
        sent = messages(0, 1, 0x1A2B, data[:payload])
        assert [len(report) for report in sent] == [64] * reports
        assert b"".join(sent)[6 : 6 + payload] == data[:payload]
        assert sent[0][2:4] == struct.pack("<H", payload + 2)


class TestLookUpTable:
    def test_the_programmers_guides_example(self) -> None:
        """Entry 1, 400 us, green, 2-bit, bit position 1."""
        entry = Entry(Place(0, 1, 2), exposure_us=400, dark_us=0, index_pulse=True, led=2, clear=True)
        assert entry.pack(1) == bytes.fromhex("01 00 90 01 00 23 00 00 00 00 00 08")

    def test_the_interleaved_period_at_132_hz(self, plugged: Plugged) -> None:
        """7576 us = 7471 + 105 dark, white, index pulse on entry 0 only."""
        plugged.projector.load([INTERLEAVED])
        sent = commands(plugged.reports_of(lambda: plugged.projector.start(INTERLEAVED, 7471.0, 105.0)))
        assert [payload for _, command, payload in sent if command == 0x1A34] == [
            bytes.fromhex("00 00 2F1D00 7E 690000 00 0000"),
            bytes.fromhex("01 00 2F1D00 7E 690000 01 0040"),
            bytes.fromhex("02 00 2F1D00 7E 690000 01 0080"),
            bytes.fromhex("03 00 2F1D00 7E 690000 01 0100"),
        ]
        assert [payload for _, command, payload in sent if command == 0x1A31] == [bytes.fromhex("04 00 00 00 00 00")]


class TestEnhancedRle:
    def test_the_printed_vector(self) -> None:
        words = np.array([[1, 1, 1, 2], [1, 1, 1, 2], [3, 4, 5, 5]])
        wanted = "03 000001 01 000002 00 01 04 00 02 000003 000004 02 000005 00 01 00"
        assert encode(pixels_of(words)) == bytes.fromhex(wanted)

    @given(
        arrays(
            np.uint32,
            st.tuples(st.integers(1, 7), st.integers(1, 300)),
            elements=st.sampled_from([0, 1, 2, 0x800000, 0xFFFFFF]),
            fill=st.sampled_from([0, 5]),
        )
    )
    @settings(max_examples=150, deadline=None)
    def test_the_device_reads_back_what_was_packed(self, words: np.ndarray) -> None:
        np.testing.assert_array_equal(decode_words(upload(pixels_of(words))), words)

    @pytest.mark.parametrize("seed", range(3))
    def test_noise_and_long_lines_too(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        words = rng.integers(0, 1 << 24, (6, 2560), np.uint32)
        words[1, 100:2500] = words[0, 100:2500]  # a copy of more than 127 pixels
        words[2, :2000] = 7
        words[3] = words[2]
        np.testing.assert_array_equal(decode_words(upload(pixels_of(words))), words)

    def test_fringes_are_small(self) -> None:
        """Three vertical-fringe patterns of 8 bits: about 10 kB, not 6 MB."""
        line = np.arange(1920) % 38
        words = np.broadcast_to(line << 16 | line << 8 | line, (1080, 1920))
        assert len(upload(pixels_of(words))) < 12_000


class TestImages:
    def test_positions_0_8_16_are_the_third_second_and_first_byte(self) -> None:
        kept = places([8, 8, 8], ["columns"] * 3)
        assert [(place.image, place.bit) for place in kept] == [(0, 0), (0, 8), (0, 16)]
        values = [np.full((1, 1), value, np.uint8) for value in (0x11, 0x22, 0x33)]
        assert pack(list(zip(kept, values, strict=True))).tolist() == [[[0x33, 0x22, 0x11]]]

    @given(st.lists(st.sampled_from([1, 2, 4, 8]), min_size=1, max_size=40))
    def test_no_two_patterns_share_a_bit(self, depths: list[int]) -> None:
        taken: set[tuple[int, int]] = set()
        for place in places(depths, depths):
            bits = {(place.image, place.bit + k) for k in range(place.depth)}
            assert not bits & taken
            assert all(bit < 24 for _, bit in bits)
            taken |= bits

    def test_more_than_the_memory_holds_is_refused(self) -> None:
        with pytest.raises(ValueError, match="holds 18"):
            places([8] * 55, ["columns"] * 55)
        assert places([8] * 54, ["columns"] * 54)[-1].image == 17

    def test_the_header(self) -> None:
        blob = upload(np.zeros((3, 5, 3), np.uint8))
        size = len(blob) - HEADER_BYTES
        assert HEADER_BYTES == 48
        assert blob[:48] == (
            b"Spld" + struct.pack("<HHI", 5, 3, size) + b"\xff" * 8 + bytes(4) + bytes([0, 2, 1]) + bytes(21)
        )


class TestUpload:
    def test_the_order_of_commands(self, plugged: Plugged) -> None:
        sent = commands(plugged.reports_of(lambda: plugged.projector.load([INTERLEAVED, CONVENTIONAL])))
        steps = [(command, payload) for flag, command, payload in sent if flag != 0xC0]
        entries = len(INTERLEAVED) + len(CONVENTIONAL)
        count = (0x1A31, struct.pack("<HI", entries, 0))
        assert steps[:3] == [(0x1A24, b"\0"), (0x1A1B, b"\3"), (0x1A24, b"\0")]
        assert [command for command, _ in steps[3:5]] == [0x1A1D, 0x1A1E]
        assert [command for command, _ in steps[5 : 5 + entries]] == [0x1A34] * entries
        assert steps[5 + entries] == steps[-1] == count
        images = steps[6 + entries : -1]
        assert {command for command, _ in images} == {0x1A2A, 0x1A2B}
        announced = [struct.unpack("<HI", payload) for command, payload in images if command == 0x1A2A]
        assert [index for index, _ in announced] == [3, 2, 1, 0]  # 12 patterns of 8 bits
        parts = [payload for command, payload in images if command == 0x1A2B]
        assert sum(size for _, size in announced) == sum(len(part) - 2 for part in parts)
        assert all(struct.unpack_from("<H", part)[0] == len(part) - 2 <= 504 for part in parts)

    def test_messages_of_several_reports_are_posted_and_then_asked_for(self, plugged: Plugged) -> None:
        sent = commands(plugged.reports_of(lambda: plugged.projector.load([INTERLEAVED])))
        for (flag, _, payload), (after_flag, after, _) in pairwise(sent):
            if len(payload) > 58:
                assert flag == 0x00
                assert (after_flag, after) == (0xC0, 0x0100)
            else:
                assert flag in (0x40, 0xC0)

    def test_the_lut_selects_the_right_bits(self, plugged: Plugged) -> None:
        plugged.projector.load([CONVENTIONAL])
        device = plugged.port.device
        for entry, pattern in zip(device.lut, CONVENTIONAL.patterns, strict=True):
            plane = bit_plane(device.words[0, entry.image], entry.position, entry.depth)
            (height, width), (w, h) = plane.shape, WINDOW
            top, left = (height - h) // 2, (width - w) // 2
            np.testing.assert_array_equal(plane[top : top + h, left : left + w], patterns.image(pattern, *WINDOW))
            assert plane.sum(dtype=np.int64) == patterns.image(pattern, *WINDOW).sum(dtype=np.int64)

    def test_a_mode_switch_is_three_reports(self, plugged: Plugged) -> None:
        """Stop, order, start: far below 100 ms at one report per ms; and the index pulse marks slot 0 only."""
        plugged.projector.load([INTERLEAVED, CONVENTIONAL])
        plugged.projector.start(INTERLEAVED, 7471.0, 105.0)
        plugged.projector.start(CONVENTIONAL, 7471.0, 105.0)
        uploads = plugged.port.device.uploads
        sent = commands(plugged.reports_of(lambda: plugged.projector.start(INTERLEAVED, 7471.0, 105.0)))
        assert [(command, payload) for _, command, payload in sent] == [
            (0x1A24, b"\0"),
            (0x1A32, struct.pack("<HI4H", 4, 0, 0, 1, 2, 3)),
            (0x1A24, b"\2"),
        ]
        assert plugged.port.device.uploads == uploads
        for show, pattern_set in zip(plugged.shows[-2:], (CONVENTIONAL, INTERLEAVED), strict=True):
            assert [pattern.trigger_2 for pattern in show.patterns] == [True] + [False] * (len(pattern_set) - 1)

    def test_halves_go_to_their_controllers(self) -> None:
        plugged = Plugged(dmd=2)
        plugged.projector.load([INTERLEAVED])
        device = plugged.port.device
        assert {where[0] for where in device.words} == {0, 1}
        for (controller, index), words in device.words.items():
            assert words.shape == (1600, 1280)
            assert words[800].any(), (controller, index)

    def test_triggers(self, plugged: Plugged) -> None:
        trigger = TriggerOut(rise_us=-20, fall_us=300, inverted=True)
        projector = Dlpc900Projector(plugged.find, WINDOW, trigger=trigger)
        projector.load([INTERLEAVED])
        assert plugged.port.device.trigger_out == {1: (True, -20, 300), 2: (True, -20, 300)}

    def test_a_window_larger_than_the_dmd_is_refused(self, plugged: Plugged) -> None:
        projector = Dlpc900Projector(plugged.find, (1921, 960))
        with pytest.raises(Exception, match=r"1921x960 .* does not fit the DLP6500's 1920x1080"):
            projector.load([INTERLEAVED])
