"""Divide long sequences of C statements into functions, with what several of them use in memory.

Compilers allocate registers in time that grows faster than linearly with the length of a function, and keep values in
memory anyway that are used far from where they are computed.
"""

import heapq
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Statement:
    """Statements that stay together.

    Attributes:
        text: the C code; variable `x5` has number 5.
        uses: numbers of the variables that it reads and does not declare.
        defines: types of the variables that it declares or assigns, by number.
        size: number of lines.
    """

    text: str
    uses: frozenset[int]
    defines: Mapping[int, str] = field(default_factory=dict)
    size: int = 1


@dataclass(frozen=True)
class Loop:
    """A loop that computes `test`, ends if the mask with the number `again` is empty, and computes `body`.

    Attributes:
        head: the loop's head in C.
        loads: declarations of variables that differ from pass to pass, by number.
    """

    test: Sequence["Statement | Loop"]
    again: int | None
    body: Sequence["Statement | Loop"]
    head: str = "for (;;)"
    loads: Mapping[int, str] = field(default_factory=dict)

    def together(self) -> Statement:
        inside = [each.together() if isinstance(each, Loop) else each for each in (*self.test, *self.body)]
        split = len(self.test)
        lines = [each.text for each in inside]
        if self.again is not None:
            lines.insert(split, f"if (!any(x{self.again})) break;")
        own = {at for each in inside for at in each.defines if at not in each.uses}
        assigned = {at: kind for each in inside for at, kind in each.defines.items() if at not in own}
        uses = frozenset(at for each in inside for at in each.uses) - own
        loaded = sorted(uses.intersection(self.loads))
        text = "\n".join([f"{self.head} {{", *(self.loads[at] for at in loaded), *lines, "}"])
        return Statement(text, uses.difference(self.loads), assigned, sum(each.size for each in inside))


def in_parts(
    items: Iterable[Statement | Loop], loads: Mapping[int, str], most: int, most_of_loop: int
) -> tuple[list[str], int]:
    """Write functions, the last of which, `samples`, calls the others.

    Args:
        loads: declarations of variables that any function may repeat, by number.
        most: number of lines of a function at most, about.
        most_of_loop: number of lines up to which a loop is not divided.

    Returns:
        The functions, and how many values they keep in memory.
    """
    parts = _Parts(loads, most, most_of_loop)
    parts.place(items)
    parts.close()
    return parts.written()


class _Parts:
    def __init__(self, loads: Mapping[int, str], most: int, most_of_loop: int):
        self._loads, self._most, self._most_of_loop = dict(loads), most, most_of_loop
        self._open: list[Statement] = []
        self._size = 0  # of what is open [lines]
        self._parts: list[list[Statement]] = []
        self._driver: list[str | int] = []  # lines, and numbers of masks that end a loop
        self._loops: list[tuple[int, int]] = []  # first and last part

    def place(self, items: Iterable[Statement | Loop]) -> None:
        for item in items:
            statement = item.together() if isinstance(item, Loop) else item
            if isinstance(item, Loop) and statement.size > self._most_of_loop:
                self._divide(item)
                continue
            if self._size + statement.size > self._most:
                self.close()
            self._open.append(statement)
            self._size += statement.size

    def _divide(self, loop: Loop) -> None:
        self.close()
        first = len(self._parts)
        self._driver.append(f"{loop.head} {{")
        self._loads |= loop.loads
        self.place(loop.test)
        self.close()
        if loop.again is not None:
            self._driver.append(loop.again)
        self.place(loop.body)
        self.close()
        self._driver.append("}")
        self._loops.append((first, len(self._parts) - 1))

    def close(self) -> None:
        if self._open:
            self._driver.append(f"part{len(self._parts)}(PASSED);")
            self._parts.append(self._open)
            self._open, self._size = [], 0

    def written(self) -> tuple[list[str], int]:
        kinds = {at: kind for part in self._parts for each in part for at, kind in each.defines.items()}
        slots, size = self._slots()
        functions = []
        for place, part in enumerate(self._parts):
            own: set[int] = set()
            used: dict[int, None] = {}
            for each in part:
                used |= dict.fromkeys(at for at in sorted(each.uses) if at not in own)
                own |= set(each.defines) - each.uses
            recalled = [self._loads.get(at) or f"{kinds[at]} x{at} = RECALL({kinds[at]}, {slots[at]});" for at in used]
            changed = dict.fromkeys(at for each in part for at in each.defines if at in slots)
            functions.append(
                "\n".join(
                    [
                        f"PART void part{place}(ARGUMENTS) {{",
                        *recalled,
                        *(each.text for each in part),
                        *(f"KEEP({kinds[at]}, {slots[at]}, x{at});" for at in changed),
                        "}",
                    ]
                )
            )
        driver = [
            line if isinstance(line, str) else f"if (!any(RECALL(mask, {slots[line]}))) break;" for line in self._driver
        ]
        return [*functions, "\n".join(["ALL_PARTS void samples(ARGUMENTS) {", *driver, "}"])], size

    def _slots(self) -> tuple[dict[int, int], int]:
        """Places in memory of the variables that several parts use, and their number; free ones are used again."""
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for place, part in enumerate(self._parts):
            for each in part:
                for at in each.defines:
                    first.setdefault(at, place)
                for at in (*each.uses, *each.defines):
                    last[at] = place
        for line in self._driver:
            if isinstance(line, int):
                last[line] += 1
        for at, begin in first.items():
            for start, end in self._loops:
                if begin < start <= last[at]:
                    last[at] = max(last[at], end)
        slots: dict[int, int] = {}
        free: list[int] = []
        ends: list[tuple[int, int]] = []
        fresh = itertools.count()
        for at, begin in sorted(first.items(), key=lambda each: each[1]):
            if last[at] == begin:
                continue
            while ends and ends[0][0] < begin:
                heapq.heappush(free, heapq.heappop(ends)[1])
            slots[at] = heapq.heappop(free) if free else next(fresh)
            heapq.heappush(ends, (last[at], slots[at]))
        return slots, next(fresh)
