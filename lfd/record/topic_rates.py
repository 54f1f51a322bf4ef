"""How often each topic of a file speaks, and when it was silent."""

from dataclasses import dataclass

import numpy as np

from lfd.record.mcap_file import McapContent

GAP = 1.5
"""An interval longer than so many median ones is a gap."""


@dataclass(frozen=True, kw_only=True)
class TopicRate:
    """One topic, by the log times of its messages."""

    topic: str
    type: str
    """Message type, or how the messages are encoded where they have none."""
    messages: int
    hz: float
    """Messages a second between the first and the last; 0 where that says nothing."""
    gaps: int
    """Intervals longer than 1.5 times the median one."""
    longest_s: float
    """The longest interval [s]."""
    longest_at_s: float
    """When it begins, after the first message of the file [s]."""

    def __str__(self) -> str:
        facts = [self.type, "1 message" if self.messages == 1 else f"{self.messages} messages"]
        if self.hz:
            facts.append(f"{self.hz:.1f} Hz")
        if self.hz and not self.gaps:
            facts.append("no gaps")
        elif self.gaps:
            count = "1 gap" if self.gaps == 1 else f"{self.gaps} gaps"
            facts.append(f"{count}, the longest of {self.longest_s:.3f} s at {self.longest_at_s:.3f} s")
        return ", ".join(facts)


def topic_rates(content: McapContent) -> list[TopicRate]:
    """The topics of a file in the order of their names, also those without a message."""
    begin = min((messages[0][0] for messages in content.messages.values() if messages), default=0)
    return [
        _rate(name, topic.schema or topic.encoding, [time for time, _ in content.messages.get(name, [])], begin)
        for name, topic in sorted(content.topics.items())
    ]


def _rate(name: str, kind: str, times_ns: list[int], begin_ns: int) -> TopicRate:
    seconds = (np.array(times_ns, dtype=np.int64) - begin_ns) / 1e9
    lengths = np.diff(seconds)
    longest = int(lengths.argmax()) if len(lengths) else 0
    span = float(lengths.sum())
    return TopicRate(
        topic=name,
        type=kind,
        messages=len(seconds),
        hz=len(lengths) / span if span > 0 else 0.0,
        gaps=int((lengths > GAP * np.median(lengths)).sum()) if len(lengths) else 0,
        longest_s=float(lengths[longest]) if len(lengths) else 0.0,
        longest_at_s=float(seconds[longest]) if len(lengths) else 0.0,
    )
