"""Builds the package with colcon; `stitch-scans` comes from pip."""

from setuptools import setup

setup(
    name="stitch_ros",
    version="0.1.0",
    packages=["stitch_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/stitch_ros"]),
        ("share/stitch_ros", ["package.xml"]),
    ],
    install_requires=["setuptools", "stitch-scans"],
    entry_points={"console_scripts": ["live_cell = stitch_ros.node:main"]},
)
