"""Settings of the documentation site: ``make docs`` builds it with warnings as errors, offline.

The source folder is the repository, so that README, docs and results link to each other by their own paths.
"""

import sys
from pathlib import Path

import cz_gym

sys.path.insert(0, str(Path(__file__).parent))

project = "Cz-v0"
author = copyright = "The Cz-v0 developers"
version = release = cz_gym.__version__
language = "en"

root_doc = "docs/index"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**.md", "results/**.md"]
exclude_patterns = [".*", "build", "dist", "runs", "results/cache", "results/README.md", "docs/_*", "**/.*"]
exclude_patterns += ["**/node_modules"]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "czdocs.mathml",
    "czdocs.tables",
    "czdocs.names",
]
nitpicky = True
nitpick_ignore = [("py:func", "make_config"), ("py:func", "prior_sds"), ("py:class", "Variation")]
nitpick_ignore_regex = [
    # Other projects' names; their inventories would have to be fetched.
    (r"py:.*", r"(numpy|np|npt|gymnasium|gym|collections|typing|pathlib|ndarray|optional|Callable|Any|Floats)\b.*"),
    (r"py:.*", r"(VecNormalize|VecEnv|BaseAlgorithm|GymEnv|Schedule|Contract|Noise|PullerFile|Block)\b.*"),
    (r"py:.*", r"(int|float|str|bool|dict|list|tuple|array|Array|Mask|Mapping|Sequence|Path)\b.*"),
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = False
highlight_language = "text"
html_math_renderer = "mathml"

autodoc_default_options = {"members": True, "member-order": "bysource", "undoc-members": True, "no-value": True}
toc_object_entries = False
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

html_theme = "furo"
html_title = f"Cz-v0 {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/favicon.svg"
html_js_files = [("access.js", {"defer": "defer"})]
html_search_scorer = str(Path(__file__).parent / "_static" / "search.js")
html_extra_path = ["_root"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
