from glob import glob

from setuptools import setup

setup(
    name="codesign_bringup",
    version="0.1.0",
    packages=["codesign_bringup"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/codesign_bringup"]),
        ("share/codesign_bringup", ["package.xml"]),
        ("share/codesign_bringup/config", glob("config/*")),
        ("share/codesign_bringup/cameras", glob("cameras/*")),
    ],
    zip_safe=True,
    maintainer="codesign maintainers",
    maintainer_email="maintainers@codesign.invalid",
    description="Starts and stops the end-effector co-design graph",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "bringup = codesign_bringup.bringup:main",
            "operate = codesign_bringup.operate:main",
            "run_trials = codesign_bringup.run_trials:main",
        ],
    },
)
