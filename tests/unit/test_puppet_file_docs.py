"""The examples of docs/puppet-file.md are files without a mistake."""

import re
from pathlib import Path

from marotte.check import check_files
from marotte.supported import NOT_YET

DOCUMENT = (Path(__file__).parents[2] / "docs" / "puppet-file.md").read_text()


def test_documentation_examples_are_without_mistakes(tmp_path):
    examples = re.findall(r"```toml\n(.*?)```", DOCUMENT, re.DOTALL)
    paths = [tmp_path / name for name in ("puppet.toml", "score.toml", "robot.toml")]
    for path, text in zip(paths, examples, strict=True):
        path.write_text(text)
    report = check_files(paths)
    assert report.mistakes == []
    assert len(report.fine) == 3


def test_documentation_names_what_is_not_supported_yet():
    section = DOCUMENT.split("## Not yet")[1] if NOT_YET else ""
    words = {
        "entry": "entry",
        "function": "[function.NAME]",
        "action_tempo": "tempo cues of single actions",
        "expression": "expressions",
    }
    assert all(words.get(feature, feature) in section for feature in NOT_YET)
