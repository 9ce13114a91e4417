from setuptools import setup

NODES = [
    "cartesian_controller",
    "fem_simulator",
    "finger_design",
    "policy",
    "simulated_camera",
    "teleop",
    "tofu_pose_estimator",
    "trial_recorder",
    "trial_runner",
    "usb_camera",
    "xarm_driver",
]

setup(
    name="codesign_nodes",
    version="0.1.0",
    packages=["codesign_nodes"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/codesign_nodes"]),
        ("share/codesign_nodes", ["package.xml"]),
    ],
    zip_safe=True,
    maintainer="codesign maintainers",
    maintainer_email="maintainers@codesign.invalid",
    description="The nodes of the end-effector co-design graph",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [f"{name} = codesign_nodes.{name}:main" for name in NODES],
    },
)
