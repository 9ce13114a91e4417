"""Camera model, calibration and the pose of the tofu in an image. Pure Python: no ROS."""

from codesign_perception.camera import Camera
from codesign_perception.camera_file import CameraFile, load_camera, save_camera
from codesign_perception.config import EstimatorConfig
from codesign_perception.tofu_pose import Detection, Held, TofuPose, TofuPoseEstimator

__all__ = [
    "Camera",
    "CameraFile",
    "Detection",
    "EstimatorConfig",
    "Held",
    "TofuPose",
    "TofuPoseEstimator",
    "load_camera",
    "save_camera",
]
