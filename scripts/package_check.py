"""Build wheel and source package, check them, and fly the demo from the installed wheel, with and without its page.

    python scripts/package_check.py            # as in `make package` and .ci/run
    python scripts/package_check.py --keep-in build/package --seconds 20

Needs only Python: the tools, and then the wheel, are installed into separate virtual environments, and the demo runs in
a folder without a checkout within reach.
"""

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import venv
import zipfile
from email.parser import BytesParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("build>=1.2", "twine>=6.1", "check-wheel-contents>=0.6")
#: Also installed by `make demo`.
EXTRAS = ("sim", "vision", "cockpit")
#: Ends without an error only if the cockpit starts with these extras and serves its page.
PAGE = """
import urllib.request
from skyloop.cockpit.child import CockpitProcess
with CockpitProcess(port=0) as page:
    assert b"<title>" in urllib.request.urlopen(page.address(), timeout=60).read()
"""
#: In the wheel beside the modules, and otherwise missed only when used.
NEEDED = (
    "skyloop/py.typed",
    "skyloop/__init__.pyi",
    "skyloop/aio/__init__.pyi",
    "skyloop/cockpit/static/index.html",
    "skyloop/cockpit/static/licences.txt",
    "skyloop/vision/weights/figures.onnx",
)
#: Needed to run the tests from the source package alone.
SOURCES = ("Makefile", "requirements-dev.txt", "tests/conftest.py", "docs/architecture.md", "cockpit-page/src/main.ts")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n")[0],
        epilog=__doc__.split("\n\n")[1],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--keep-in", type=Path, metavar="FOLDER", help="keep wheel and source package there")
    parser.add_argument("--seconds", type=float, default=10.0, help="flight time of the demo [s]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="skyloop-package-") as folder:
        work = Path(folder)
        packages = options.keep_in.resolve() if options.keep_in else work / "dist"
        tools = environment(work / "tools", *TOOLS)
        step("wheel and source package are built, the wheel from the source package")
        run(tools, "-m", "build", "--outdir", packages, ROOT)
        (wheel,), (source,) = (sorted(packages.glob(pattern)) for pattern in ("*.whl", "*.tar.gz"))
        run(tools, "-m", "twine", "check", "--strict", wheel, source)
        run(tools, "-m", "check_wheel_contents", wheel)
        check_wheel(wheel)
        check_source(source)
        step(f"{wheel.name} is installed into an empty environment, then {', '.join(EXTRAS)} by skyloop install")
        python = environment(work / "bare", wheel)
        run(python.parent / "skyloop", "install", *EXTRAS, cwd=work)
        step("the demo is flown there")
        home = work / "home"
        home.mkdir()
        command = ("skyloop", "demo", "--headless", "--seconds", f"{options.seconds:g}")
        run(python.parent / command[0], *command[1:], cwd=home)
        step("its page is served there")
        run(python, "-c", PAGE, cwd=home)
    print("ok: built, checked, installed and flown", flush=True)


def check_wheel(wheel: Path) -> None:
    """Check the description shown by package indexes, and the files that are not modules."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = BytesParser().parsebytes(archive.read(next(name for name in names if name.endswith("/METADATA"))))
    missing = [name for name in NEEDED if name not in names]
    assert not missing, f"the wheel lacks {missing}"
    text = str(metadata.get_payload())
    relative = [link for link in re.findall(r"\]\(([^)#][^)]*)\)", text) if not link.startswith("https://")]
    assert text.strip(), "the wheel has no description"
    assert not relative, f"on an index's page these links of README.md lead nowhere: {relative}"
    classifiers = metadata.get_all("Classifier", [])
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    oldest = f"Programming Language :: Python :: {wanted.removeprefix('>=')}"
    assert oldest in classifiers, f"requires-python is {wanted}, and the classifiers lack {oldest!r}"


def check_source(source: Path) -> None:
    """Check that the source package has everything its tests need, and nothing built or installed."""
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    missing = [name for name in SOURCES if name not in names]
    assert not missing, f"the source package lacks {missing}"
    strange = [name for name in names if re.search(r"(^|/)(node_modules|\.venv|__pycache__|\.third-party)/", name)]
    assert not strange, f"the source package has {strange[:3]}"


def environment(folder: Path, *requirements: str | Path) -> Path:
    """Create a virtual environment with these requirements, and return its Python."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements)
    return python


def run(program: Path, *arguments: str | Path, cwd: Path | None = None) -> None:
    """Run a program to its end, showing its output; raise if it fails."""
    # Neither the checkout nor another environment may be within reach of the tested code.
    kept = {
        name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
    }
    done = subprocess.run([str(program), *map(str, arguments)], cwd=cwd, env=kept, check=False)
    if done.returncode != 0:
        sys.exit(f"{program.name} {' '.join(map(str, arguments))} ended with {done.returncode}")


def step(text: str, begin: float = time.monotonic()) -> None:
    """Print the present step, and the seconds since the start."""
    print(f"[{time.monotonic() - begin:5.1f} s] {text}", flush=True)


if __name__ == "__main__":
    main()
