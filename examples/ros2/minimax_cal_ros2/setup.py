"""As `ament_python` wants it."""

from setuptools import setup

NAME = "minimax_cal_ros2"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/corrected.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={"console_scripts": [f"record = {NAME}.record:main"]},
)
