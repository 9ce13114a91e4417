"""Quality of service of the graph, in one place. The README's table states the same."""

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

# What a writer keeps for readers that are late with their acknowledgement: with 10 the recorder
# lost messages when simulated time ran fast.
KEPT = 200


def command(deadline: float, depth: int = 1) -> QoSProfile:
    """Actions, commands and poses: they must arrive, and of poses and commands only the newest.

    Args:
        deadline: longest time between two messages [s]; a subscription asks for no less than
            what the publisher offers.
        depth: messages kept while the reader is busy.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        deadline=Duration(seconds=deadline),
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Duration(seconds=2.0),
    )


# What the publishers offer is kept a little, so that a recorder which asks for reliable delivery
# loses nothing; control loops ask for STATE.
STATE_OFFERED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=KEPT, reliability=ReliabilityPolicy.RELIABLE
)
STATE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# For consumers that must see every message: metrics and status.
EVERY = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.RELIABLE
)

# Longest time between two messages [s]: offered by the publisher, asked for by the subscriber.
# Actions are increments: one that is overwritten in the queue is missing from the pose for good.
ACTION_OFFERED, ACTION_REQUESTED = command(0.10, KEPT), command(0.15, depth=5)
# Set-points carry the moment that they are meant for; a late reader still wants those in between.
JOINT_COMMAND_OFFERED, JOINT_COMMAND_REQUESTED = command(0.05, KEPT), command(0.10, depth=10)
GRIPPER_COMMAND_OFFERED, GRIPPER_COMMAND_REQUESTED = command(0.10, KEPT), command(0.20)
# The writer keeps a few, for the recorder and the judge who want them all.
POSE_OFFERED, POSE_REQUESTED = command(0.10, KEPT), command(0.20)
# Pictures: whole ones only, and of those the newest.
IMAGE_OFFERED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE
)
IMAGE_REQUESTED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE
)
