"""Print pip constraints that pin every dependency of pyproject.toml to the oldest version it allows."""

import pathlib
import re
import tomllib

project = tomllib.loads(pathlib.Path("pyproject.toml").read_text())["project"]
extras = project["optional-dependencies"]
for line in [*project["dependencies"], *(entry for group in extras.values() for entry in group)]:
    found = re.match(r"([\w.-]+)(?:\[[\w,]+\])?>=([\d.]+)", line)
    if found:
        print(f"{found[1]}=={found[2]}")
# matplotlib of that time calls names of pyparsing that later releases warn about
print("pyparsing<3.2")
