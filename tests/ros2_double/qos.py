"""Quality of service: what publishers offer, and what is asked of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from tests.ros2_double.arguments import RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_POLICIES: Final = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
    "liveliness": LivelinessPolicy,
}
_DURATIONS: Final = ("deadline", "lifespan", "liveliness_lease_duration")
_PROMISES: Final = (
    ("reliability", ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
    ("durability", DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE),
)
_DEPTH: Final = 10


def offered(profile: Any) -> dict[str, str | int]:
    """One publisher's profile, as `metadata.qos_text` takes it."""
    policies = {name: getattr(profile, name).name.lower() for name in _POLICIES}
    return {
        **policies,
        "depth": profile.depth,
        **{name: getattr(profile, name).nanoseconds for name in _DURATIONS},
    }


def adapted(topic: str, offers: Sequence[Any], warn: Callable[[str], None]) -> Any:
    """What every publisher can meet: a promise is asked for where all of them make it."""
    asked: dict[str, Any] = {}
    for policy, promise, fallback in _PROMISES:
        made = [getattr(offer, policy) == promise for offer in offers]
        asked[policy] = promise if all(made) else fallback
        if any(made) and not all(made):
            warn(
                f'Some, but not all, publishers on topic "{topic}" are offering '
                f"RMW_QOS_POLICY_{policy.upper()}_{promise.name}. Falling back to "
                f"RMW_QOS_POLICY_{policy.upper()}_{fallback.name} "
                "as it will connect to all publishers."
            )
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=_DEPTH, **asked)


def refused(topic: str, offers: Sequence[Any], asked: Any) -> str | None:
    """The warning about a publisher that cannot meet what was asked of the first ones."""
    for offer in offers:
        for policy, promise, less in _PROMISES:
            if getattr(asked, policy) == promise and getattr(offer, policy) == less:
                name = f"RMW_QOS_POLICY_{policy.upper()}"
                itself = "rosbag" if policy == "reliability" else "rosbag2"
                return (
                    f"A new publisher for subscribed topic {topic} was found offering "
                    f"{name}_{less.name}, but {itself} already subscribed requesting "
                    f"{name}_{promise.name}. "
                    "Messages from this new publisher will not be recorded."
                )
    return None


def overrides(text: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Profiles by topic.

    Raises:
        RefusedError: as rosbag2 and rclpy refuse it, or a value that is not known.
    """
    return {topic: _override(topic, given) for topic, given in text.items()}


def _override(topic: str, given: dict[str, Any]) -> Any:
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in {*_POLICIES, "depth"}:
            raise RefusedError(f"Unexpected key `{name}` for QoS profile.")
        try:
            values[name] = value if name == "depth" else _POLICIES[name][str(value).upper()]
        except KeyError:
            raise RefusedError(f"{topic}: {name} cannot be {value!r}") from None
    try:
        return QoSProfile(**values)
    except InvalidQoSProfileException as error:
        raise RefusedError(str(error)) from None
