"""Camera model, calibration and the pose of the tofu in an image. Pure Python: no ROS."""

from codesign_perception.camera import Camera

__all__ = ["Camera"]
