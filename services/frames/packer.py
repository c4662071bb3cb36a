"""The packer: answers who asks for a frame with the newest one, packed as he wants it.

It hears frames only while somebody asks. A frame is packed once for all who want it alike.
"""

from __future__ import annotations

import asyncio

import msgspec

from cocoro.component import Implementation
from cocoro.errors import CocoroError
from cocoro.messages import Frame, PackedFrame, PackedRequest
from cocoro.node import Node
from cocoro.topics import FRAME, PACKED
from services.frames.packing import pack

HELD_S = 0.5
"""How long a question waits for a frame that its reader does not have yet."""
IDLE_S = 5.0
"""After so long without a question frames are not heard any more."""


class PackerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The packer has no settings: each reader says what it wants."""


class Packer:
    """The packer's work; `run` never returns."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._newest: Frame | None = None
        self._arrived = asyncio.Event()
        self._packed: dict[tuple[int, int], PackedFrame] = {}
        """The newest frame, by divisor and quality."""
        self._asked_s = 0.0
        self._hearing = False

    async def run(self) -> None:
        self._node.serve(PACKED, self._answer)
        self._node.ready("nobody asks for frames")
        while True:
            await asyncio.sleep(IDLE_S)
            if self._hearing and asyncio.get_running_loop().time() - self._asked_s > IDLE_S:
                self._hearing = False
                self._node.drop(FRAME)
                self._newest = None
                self._packed.clear()
                self._node.ready("nobody asks for frames")

    async def _answer(self, question: PackedRequest) -> PackedFrame:
        loop = asyncio.get_running_loop()
        begun_s = self._asked_s = loop.time()
        if not self._hearing:
            self._hearing = True
            self._node.on(FRAME, self._on_frame)
            self._node.ready("packs frames")
        has = (question.after_incarnation, question.after_seq)
        try:
            async with asyncio.timeout(HELD_S):
                while self._newest is None or (self._newest.incarnation, self._newest.seq) == has:
                    self._arrived.clear()
                    await self._arrived.wait()
        except TimeoutError:
            raise CocoroError(f"no frame from the camera within {HELD_S:g} s") from None
        level = (question.divisor, question.quality)
        packed = self._packed.get(level)
        if packed is None:
            packed = self._packed[level] = pack(self._newest, *level)
        return msgspec.structs.replace(packed, held_s=loop.time() - begun_s)

    def _on_frame(self, frame: Frame) -> None:
        self._newest = frame
        self._packed = {}
        self._arrived.set()


async def run(node: Node, _config: PackerConfig) -> None:
    """Answers for ever."""
    await Packer(node).run()


implementation = Implementation(PackerConfig, run)
