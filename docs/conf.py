# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Sphinx builds these pages with `make docs`; rosdoc2 builds the same for docs.ros.org."""

from contextlib import redirect_stdout, suppress
from dataclasses import is_dataclass
import inspect
import io
import math
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
_MANIFEST = ElementTree.parse(ROOT / 'package.xml').getroot()

project = str(_MANIFEST.findtext('name'))
author = str(_MANIFEST.findtext('author'))
release = version = str(_MANIFEST.findtext('version'))
project_copyright = '2026 The gyro_calibration maintainers'

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
exclude_patterns = ['examples']
# the anchors of headings as GitHub makes them, so that a link holds in both places
myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence']
highlight_language = 'none'

add_module_names = False
autodoc_typehints = 'none'
autodoc_member_order = 'bysource'
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

# the theme of docs.ros.org
html_theme = 'sphinx_rtd_theme'
html_theme_options = {'navigation_depth': 2, 'prev_next_buttons_location': None}
html_static_path = ['_static']
html_css_files = ['tables.css']
html_show_sourcelink = False


def write_verbs(app):
    """Write the page of the verbs, by their own help."""
    from gyro_calibration.cli.main import find_verbs, make_parser
    helps = {}
    for name in find_verbs():
        with redirect_stdout(io.StringIO()) as text, suppress(SystemExit):
            make_parser(name).parse_args([name, '--help'])
        helps[name] = text.getvalue()
    (ROOT / 'docs/reference/verbs.md').write_text('# Options of the verbs\n\n' + '\n'.join(
        f'## {name}\n\n```text\n{text}```\n' for name, text in helps.items()))


def describe_entries(app, what, name, obj, options, lines):
    """Put what docstrings write as `name : description` in the place of a description."""
    lines[:] = [part for line in lines for part in _split_entry(line)]


def _split_entry(line):
    found = re.fullmatch(r'( *)(\w+(?:, \w+)*) : (.+)', line)
    # a blank between names would make the first of them the type of the last
    return ([found[1] + found[2].replace(', ', ','), f'{found[1]}    {found[3]}'] if found
            else [line])


def describe_fields(app, what, name, obj, options, lines):
    """Append what the comments of a record state of its fields."""
    if what != 'class' or not is_dataclass(obj):
        return
    entries, before = [], ''  # a comment in lines before a field holds for the next ones, too
    is_continued = False
    for line in inspect.getsource(obj).splitlines():
        if re.match(' +(@|def )', line):
            break
        field = re.match(r'    (\w+): .*?(?:  # (.*))?$', line)
        comment = re.match(r'    #:? (.*)', line)
        if field and not field[1].startswith('_'):
            before = '' if field[2] else before
            entries += [field[1], f'    {field[2] or before}']
        elif comment:
            before = f'{before} {comment[1]}' if is_continued else comment[1]
        is_continued = bool(comment)
    if entries:
        title = 'Attributes' if _is_result(obj) else 'Parameters'
        lines += ['', title, '-' * len(title), *entries, '']


def hide_results(app, what, name, obj, options, signature, returns):
    """Show no signature of a record that only functions make."""
    return ('', None) if what == 'class' and _is_result(obj) else None


def _is_result(obj):
    from gyro_calibration.cli.verb import PrintedResult
    return issubclass(obj, PrintedResult)


def describe_formats(app, docname, source):
    """Append the numbers of each wire format, and what its module states of it, to their page."""
    if docname != 'reference/wire_formats':
        return
    from gyro_calibration.driver.protocols import PROTOCOLS, Settings
    columns = ('`protocol`', 'baud', 'samples a second', 'unit, deg/s', 'positive',
               'full scale, deg/s', 'noise, deg/s/√Hz')
    rows = ['## The formats', '', f'| {" | ".join(columns)} |', '|---' * len(columns) + '|']
    for name, format_ in PROTOCOLS.items():
        unit, noise = format_.sensitivity, format_.noise_density
        full_scale = math.degrees(format_.effective_full_scale(Settings()))
        angles = ' since the last sample' if format_.increments else ''
        rows.append(
            f'| [`{name}`](#{name}) | {format_.baud} | {format_.rate:g} | '
            f'{f"{math.degrees(unit):.5g}{angles}" if unit else "must be set"} | '
            f'{"clockwise, inverted" if format_.invert else "counter-clockwise"} | '
            f'{f"{full_scale:.6g}" if unit else f"{format_.largest_count} counts"} | '
            f'{f"{math.degrees(noise):.2g}" if noise else "not known"} |')
    sections = [f'### {name}\n\n{format_.text.strip()}' for name, format_ in PROTOCOLS.items()]
    source[0] += '\n\n'.join(['\n' + '\n'.join(rows), *sections, ''])


def setup(app):
    """Write pages; describe before napoleon (priority 500) reads the sections."""
    app.connect('builder-inited', write_verbs)
    app.connect('autodoc-process-docstring', describe_entries, priority=400)
    app.connect('autodoc-process-docstring', describe_fields, priority=450)
    app.connect('autodoc-process-signature', hide_results)
    app.connect('source-read', describe_formats)
