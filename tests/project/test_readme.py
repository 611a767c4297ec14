"""What README promises: its scripts run, its links lead somewhere, its command is the one of CI."""

import re
import subprocess
import sys
from urllib.parse import urlsplit

import pytest

from tests import ROOT
from tests.project.readme import LINKS, README, blocks
from tests.project.repository import need

need("docs", ".ci")  # where links lead, and the command of CI
# Whom README cites; another host is added here on purpose.
HOSTS = {
    "docs.jax.dev",
    "docs.kidger.site",
    "docs.scipy.org",
    "docs.sciml.ai",
    "sourceforge.net",
    "nonsmooth.gricad-pages.univ-grenoble-alpes.fr",
}


def test_ci_runs_the_test_command_in_readme():
    (command,) = [c for c in blocks("bash") if "pytest" in c]
    pattern = re.search(r"grep -m 1 '(.*)' README.md", (ROOT / ".ci/run").read_text()).group(1)
    found = [line for line in README.splitlines() if re.search(pattern, line)]
    assert found[0] == command.strip()


@pytest.mark.slow
@pytest.mark.parametrize("script", blocks("python"), ids=lambda s: s.splitlines()[0])
def test_a_script_in_readme_runs(script, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def anchors():
    """What headings of README are called in a link."""
    for heading in re.findall(r"^#+ (.*)$", README, re.M):
        yield "#" + re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("link", LINKS)
def test_a_link_in_readme_leads_somewhere(link):
    url = urlsplit(link)
    if url.scheme:
        assert url.scheme == "https" and url.netloc in HOSTS
        assert re.fullmatch(r"(/[\w.-]+)*/?", url.path) and not url.query
    elif link.startswith("#"):
        assert link in anchors()
    else:
        file = (ROOT / link).resolve()
        assert file.is_relative_to(ROOT) and file.exists()


def test_a_link_in_readme_is_spelled_one_way():
    spellings = {}
    for link in LINKS:
        plain = link.lower().replace("://www.", "://").removesuffix("index.html").rstrip("/")
        spellings.setdefault(plain, set()).add(link)
    assert [several for several in spellings.values() if len(several) > 1] == []


def test_every_host_that_may_be_cited_is():
    assert {urlsplit(link).netloc for link in LINKS} - {""} == HOSTS
