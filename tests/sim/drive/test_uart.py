"""The simulated UART: pace, and what a receiver at another rate reads."""

from __future__ import annotations

import pytest

from sim.ports.uart import Pacer, misread

EVERY = bytes(range(256))


def test_pacer_gives_a_tenth_of_the_baud_rate_in_bytes() -> None:
    pacer = Pacer(115200)
    sent = 0
    for step in range(1001):
        n = pacer.allowance(step * 0.001)
        pacer.spend(n)
        sent += n
    assert sent == pytest.approx(11520, abs=1)


@pytest.mark.parametrize(("baud", "most"), [(115200, 230), (300, 1)])  # 20 ms of line time, a byte at least
def test_pacer_does_not_save_up_a_pause(baud: int, most: int) -> None:
    pacer = Pacer(baud)
    pacer.allowance(0.0)
    assert pacer.allowance(10.0) == most


@pytest.mark.parametrize("received", [115200, 115200 * 1.029, 115200 / 1.03])
def test_rates_within_tolerance_read_alike(received: float) -> None:
    assert misread(EVERY, 115200, int(received)) == EVERY


def test_half_rate_reads_known_characters() -> None:
    # The receiver samples the sender's bits 1, 3, 5, 7, 9 (0 = start, 9 = stop) and then the idle line.
    # 'U': bits 1, 3, 5, 7 are high, at bit 1 it is no start bit; after each falling edge the same.
    assert misread(b"U", 115200, 57600) == b""
    # 0x00: bit 1 low = start; 3, 5, 7 low, 9 and the idle line high.
    assert misread(b"\0", 115200, 57600) == bytes([0b11111000])


def test_double_rate_reads_known_characters() -> None:
    # 0xFF: one low bit of the sender is two of the receiver: start and one zero, then ones.
    assert misread(b"\xff", 57600, 115200) == b"\xfe"
    # 0x00: eighteen low bits: a stop bit that reads low, dropped, and the line then rises.
    assert misread(b"\0", 57600, 115200) == b""


@pytest.mark.parametrize("received", [300, 9600, 57600, 921_600, 3_000_000])
def test_other_rates_read_rubbish(received: int) -> None:
    assert misread(EVERY, 115200, received) != EVERY


@pytest.mark.parametrize("rates", [(0, 115200), (115200, 0)])
def test_a_rate_of_zero_is_hung_up(rates: tuple[int, int]) -> None:
    assert misread(EVERY, *rates) == b""
