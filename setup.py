"""The packages of the wheel: the folders of the project that pyproject.toml places inside
``gsfusion_nb``, too."""

from setuptools import find_namespace_packages, find_packages, setup

setup(
    packages=[
        *find_packages(include=["gsfusion_nb", "gsfusion_nb.*"]),
        *(
            f"gsfusion_nb.{name}"
            for name in find_namespace_packages(
                include=["kernels", "kernels.*"], exclude=["*.__pycache__"]
            )
        ),
        "gsfusion_nb.docs",
        "gsfusion_nb.notebooks",
    ]
)
