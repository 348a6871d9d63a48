"""The device side in C under sanitizers: vectors, any frames, and interrupts between any two instructions."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from building import HERE, LARGE, ROOT, SANITIZED, SMALL, SOURCE, build, compiler, options, run

from protocol.framing import Deframer, parse_frame

pytestmark = pytest.mark.slow

VECTORS = {file.stem: json.loads(file.read_text()) for file in (ROOT / "protocol" / "vectors").glob("*.json")}
AS_IN_VECTORS = {
    "RX_MAX": 1024, "TX_MAX": 1024, "TX_BYTES": 8192, "POOL_BYTES": 4096, "CAN_BYTES": 64, "CAN_MESSAGES": 512,
}  # fmt: skip
DAMAGED = ("aborted", "bad_crc", "bad_length")
MANY_CHANNELS = {"HOSTS": 2, "CHANNELS": 60}
SHAPES = [
    pytest.param("gcc", MANY_CHANNELS, "byte", 40_000, id="gcc, byte link"),
    pytest.param("gcc", MANY_CHANNELS, "can", 60_000, id="gcc, CAN"),
    pytest.param("gcc", MANY_CHANNELS, "byte", 300_000, id="gcc, byte link, long", marks=pytest.mark.campaign("c")),
    pytest.param("gcc", MANY_CHANNELS, "can", 500_000, id="gcc, CAN, long", marks=pytest.mark.campaign("c")),
    pytest.param("clang", SMALL, "byte", 100_000, id="clang, byte link, small", marks=pytest.mark.campaign("c")),
    pytest.param("clang", LARGE, "can", 100_000, id="clang, CAN FD, large", marks=pytest.mark.campaign("c")),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A program, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("c")
    made: dict[tuple[str, ...], Path] = {}

    def program(*what: str, can: bool = True) -> Path:
        if what not in made:
            made[what] = build(folder / f"program{len(made)}", *what, can=can)
        return made[what]

    return program


# -- vectors ----------------------------------------------------------------------------------------------------------


class Replayed:
    """Lines of a script, and then what the drive told after each."""

    def __init__(self, program: Path) -> None:
        self._program = program
        self._lines: list[str] = []
        self.told: list[list[str]] = []

    def do(self, line: str) -> int:
        """One more line; its number."""
        self._lines.append(line)
        return len(self._lines) - 1

    def run(self) -> None:
        """All of it."""
        out = run(self._program, text="".join(f"{line}\n" for line in self._lines))
        self.told = [line.split(" ") for line in out.splitlines()]
        assert len(self.told) == len(self._lines)

    def bad(self, k: int) -> int:
        """Damaged frames up to line `k`."""
        return int(self.told[k][0], 16)

    def sent(self, k: int) -> str:
        """Bytes that line `k` made the drive send, in hexadecimal."""
        return self.told[k][2]


@pytest.fixture
def replayed(built: Callable[..., Path]) -> Replayed:
    return Replayed(built("gcc", "replay.c", "-O1", *SANITIZED, *options(AS_IN_VECTORS)))


def test_framing_vectors(replayed: Replayed) -> None:
    looked: list[tuple[int, dict]] = []
    for case in VECTORS["framing"]:
        for cut in {0, len(case["wire_hex"]) // 4 * 2, 2}:
            replayed.do("new 1")
            replayed.do(f"rx {case['wire_hex'][:cut]}")
            looked.append((replayed.do(f"rx {case['wire_hex'][cut:]}"), case))
    replayed.run()
    for k, case in looked:
        assert replayed.bad(k) == (case["verdict"] not in ("ok", "nothing")), case["name"]
        if case["verdict"] != "ok":
            assert replayed.sent(k) == "", case["name"]


def test_exchange_vectors(replayed: Replayed) -> None:
    looked: list[tuple[int, dict]] = []
    for case in VECTORS["exchanges"]:
        replayed.do("new 1")
        looked += [(replayed.do(f"rx {case['request_hex']}"), case) for _ in range(2)]
        replayed.do("fault 2")
        looked.append((replayed.do(f"rx {case['request_hex']}"), case))
    replayed.run()
    for k, case in looked:
        assert replayed.sent(k) == case["reply_hex"], case["name"]


def test_sequence_vectors(replayed: Replayed) -> None:
    looked: list[tuple[int, dict, str]] = []
    for case in VECTORS["sequences"]:
        replayed.do(f"new {case['features']:x}")
        looked += [(replayed.do(f"rx {step['request_hex']}"), step, case["name"]) for step in case["steps"]]
    replayed.run()
    for k, step, name in looked:
        sent = bytes.fromhex(replayed.sent(k))
        raws = Deframer().feed(b"\0" + sent)
        replies = [raw for raw in raws if parse_frame(raw).is_reply]
        if step["reply_hex"] is None:
            (asked,) = (parse_frame(raw) for raw in Deframer().feed(bytes.fromhex(step["request_hex"])))
            (reply,) = map(parse_frame, replies)
            assert (reply.type, reply.tid, reply.is_error) == (asked.type, asked.tid, False), name
        elif step["reply_hex"]:
            assert step["reply_hex"] in replayed.sent(k), name
            assert len(replies) == 1, name
        else:
            assert not replies, name


def test_all_other_vectors_do_no_harm(replayed: Replayed) -> None:
    """What devices send, and streams, come to a drive by mistake only."""
    replayed.do("new 1")
    for name in ("messages", "streams"):
        for case in VECTORS[name]:
            wires = case["wire_hex"] if isinstance(case["wire_hex"], list) else [case["wire_hex"]]
            for wire in wires:
                replayed.do(f"rx {wire}")
    for case in (*VECTORS["can_messages"], *VECTORS["can_streams"]):
        fd = case.get("fd", case.get("config", {}).get("fd", False))
        replayed.do(f"bus {fd:x} {case.get('extended', False):x}")
        for number, data in case["frames"]:
            for identifier in (number, number & ~0x700 | 0x200, 0x210):
                replayed.do(f"can {identifier:x} {data}")
    replayed.run()


def test_can_message_vectors_to_a_device(replayed: Replayed) -> None:
    """Transfers of vectors/can_messages.json are damaged for a device as for a host."""
    looked: list[tuple[int, dict]] = []
    for case in VECTORS["can_messages"]:
        if case["host"] or any(number & 0x7FF != 0x310 for number, _ in case["frames"]):
            continue
        replayed.do(f"bus {case['fd']:x} {case['extended']:x}")
        last = 0
        for number, data in case["frames"]:
            last = replayed.do(f"can {number & ~0x700 | 0x200 | (number & 0x80000000):x} {data}")
        looked.append((last, case))
    replayed.run()
    assert len(looked) > 30
    for k, case in looked:
        assert replayed.bad(k) == sum(case["counts"].get(kind, 0) for kind in DAMAGED), case["name"]


# -- whatever comes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "values", "link", "frames"), SHAPES)
def test_any_frames(built: Callable[..., Path], name: str, values: dict[str, int], link: str, frames: int) -> None:
    said = run(built(name, "fuzz.c", "-O1", *SANITIZED, *options(values)), link, str(frames), "1")
    assert said.startswith(f"{frames} frames, ")


def test_frames_for_a_32_bit_core(built: Callable[..., Path]) -> None:
    program = built("gcc", "fuzz.c", "-m32", "-O2")
    for link in ("byte", "can"):
        run(program, link, "50000", "2")


@pytest.mark.campaign("c")
def test_a_fuzzer_that_looks_for_new_paths(built: Callable[..., Path], tmp_path: Path) -> None:
    compiler("clang", "-fsanitize=fuzzer")
    flags = ("-O1", "-fsanitize=fuzzer", *SANITIZED[1:2], "-fno-sanitize-recover=all")
    program = built("clang", "fuzz.c", *flags, "-DLIBFUZZER", "-DHBP_HOSTS=2")
    run(program, "-runs=1000", "-seed=1", "-max_len=4096", "-len_control=0", f"-artifact_prefix={tmp_path}/")


# -- interrupts -------------------------------------------------------------------------------------------------------


@pytest.fixture
def interrupts(built: Callable[..., Path]) -> Path:
    return built("gcc", "interrupts.c", "-O2", "-g", "-DHBP_CHANNELS=8", can=False)


@pytest.mark.parametrize("steps", ["60000", pytest.param("300000", marks=pytest.mark.campaign("c"))])
def test_an_interrupt_between_any_two_instructions(interrupts: Path, steps: str) -> None:
    said = run(interrupts, "step", steps, "4")
    assert re.match(r"[1-9]\d* sessions", said)


@pytest.mark.real_time
def test_a_timer_interrupts(interrupts: Path) -> None:
    said = run(interrupts, "timer", "2", "1")
    assert re.match(r"[1-9]\d* sessions", said)


@pytest.mark.campaign("c")
@pytest.mark.parametrize(
    ("was", "by"),
    [
        ("if (link->decoded < sizeof link->rx)", "if (1)"),
        ("if (used + needed > HBP_TX_BYTES) return 0;", "if (used + needed > HBP_TX_BYTES + 64) return 0;"),
        ("if (!send_edges(h) || !h->link->way->samples", "if (!h->link->way->samples"),
    ],
)
def test_a_planted_fault_is_found(tmp_path: Path, was: str, by: str) -> None:
    for file in (*SOURCE.glob("*.[ch]"), *HERE.glob("*.[ch]")):
        text = file.read_text()
        if file.name == "hbp.c":
            assert was in text
            text = text.replace(was, by)
        copy = tmp_path / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(text)
    folder = tmp_path / HERE.relative_to(ROOT)
    files = [folder / "fuzz.c", *(tmp_path / "protocol" / "c" / name for name in ("hbp.c", "hbp_can.c"))]
    run(compiler("gcc", *SANITIZED), "-std=c99", "-O0", *SANITIZED, *files, "-o", tmp_path / "fuzz")
    with pytest.raises(AssertionError, match=r"not so|runtime error|AddressSanitizer"):
        run(tmp_path / "fuzz", "byte", "60000", "1")
