# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The report of a diagnosis: one self-contained page, opened in a browser, narrow and wide."""

from dataclasses import replace
from html import escape, unescape
from html.parser import HTMLParser
import json
from pathlib import Path
import re
import subprocess

from gyro_calibration.diagnosis import report
from gyro_calibration.diagnosis.causes import mark_suspected
from gyro_calibration.diagnosis.findings import (
    Change, Curve, Diagnosis, Estimate, Finding, Gain, Reference, Unexplained)
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.diagnosis.words import (
    format_quantity, headline, terminal_lines)
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

CHROMIUM = Path('/usr/bin/chromium')
HOSTILE = ('</title></script><script>document.title = "taken"</script><img '
           'src="http://example.org/x.png" onerror="alert(1)">&"\'\x1b[2J\udcff.csv')


def curve(along, unit, at, error, mended, deviation=0.01 * DEGREE):
    """Return a curve whose error is wholly before, and partly mended after."""
    generator = np.random.default_rng(len(along))
    before = error + deviation * generator.standard_normal(len(at))
    return Curve(along, unit, at, before, before - mended * error, np.full(len(at), deviation),
                 0.1 * DEGREE + 0.0 * at)


TEMPERATURE = np.linspace(18.0, 41.0, 24)
HEADING = np.linspace(-np.pi, np.pi, 37)
RATE = np.linspace(-100.0, 100.0, 31) * DEGREE
TIME = np.linspace(0.0, 1500.0, 40)


def temperature_finding(ambiguous=('rate_ramp',)):
    size = Estimate(0.021 * DEGREE, (0.0203 * DEGREE, 0.0217 * DEGREE), 'rad/s/K')
    return Finding('bias_temperature', CATALOGUE['bias_temperature'].cause,
                   {'bias_temperature': size}, 1e-9, 0.0009 * DEGREE, ambiguous,
                   'heat and cool the gyro within one log' if ambiguous else '',
                   'From 18 to 41 °C the residual rises by 0.48 deg/s.', 'temperature')


def adequate():
    return Diagnosis((), (), Noise(1e-4, 2e-5, 1e-6), Noise(1e-4, 2e-5, 1e-6), None, GyroModel(),
                     GyroModel(), logs=('still.csv',),
                     curves=[curve('temperature', 'degC', TEMPERATURE, 0.0 * TEMPERATURE, 0.0)])


def extended():
    """Return a diagnosis with one cause that remains in a set, and everything there is to draw."""
    model = GyroModel((Term(CATALOGUE['bias'], (0.1 * DEGREE,)),
                       Term(CATALOGUE['bias_temperature'], (25.0, 0.021 * DEGREE))),
                      np.diag([1e-9, 1e-12]), (-1.745, 1.745), (18.0, 41.0),
                      noise=Noise(1e-4, 2e-5, 1e-6), gyro={'name': 'yaw gyro'})
    thermal = (TEMPERATURE - 25.0) * 0.021 * DEGREE
    curves = [curve('temperature', 'degC', TEMPERATURE, thermal, 0.98),
              curve('rate', 'rad/s', RATE, 0.0 * RATE, 0.0),
              curve('time', 's', TIME, 1e-4 * TIME * DEGREE, 0.97),
              curve('heading', 'rad', HEADING, 0.0 * HEADING, 0.0)]
    gain = Gain('every second block of 150 s',
                Change(0.31 * DEGREE, 0.12 * DEGREE, (0.17 * DEGREE, 0.21 * DEGREE)),
                Change(8.2 * DEGREE, 1.1 * DEGREE, (6.6 * DEGREE, 7.7 * DEGREE)))
    no_force = 'the log holds no specific force'
    cannot_show = {'supply_sensitivity': 'the log holds no supply voltage',
                   'acceleration_sensitivity': no_force, 'vibration_rectification': no_force}
    return Diagnosis((temperature_finding(),), (), Noise(1.3e-4, 2e-5, 0.0),
                     Noise(1e-4, 2e-5, 1e-6), gain, replace(model, terms=model.terms[:1]), model,
                     cannot_show, curves, heading_curve(45000), noise_curve(),
                     ('12 lost samples were left out.', 'the reference is an encoder'),
                     logs=('turntable.csv.gz',), trace=trace())


def heading_curve(count):
    time = np.linspace(0.0, 900.0, count)
    walk = (
        np.cumsum(np.random.default_rng(3).standard_normal(count)) * 0.4 / np.sqrt(count) * DEGREE)
    return Curve('time', 's', time, walk + 9.0 * DEGREE * (time / 900.0) ** 2, walk)


def noise_curve():
    times = np.geomspace(0.02, 300.0, 50)
    fitted = np.sqrt(1.3e-4 ** 2 / times + (0.664 * 2e-5) ** 2)
    return Curve('averaging time', 's', times,
                 fitted * (1.0 + 0.05 * np.sin(np.arange(50.0))), fitted,
                 simulated=np.sqrt(1e-8 / times + 1e-12 * times / 3.0))


def trace():
    time = np.linspace(412.0, 424.0, 600)
    noise = 0.1 * DEGREE * np.random.default_rng(4).standard_normal(600)
    return Curve('time', 's', time, noise + 0.4 * DEGREE, noise,
                 simulated=60.0 * DEGREE * np.sin(1.2 * time) - 0.4 * DEGREE)


def unexplained():
    return replace(
        adequate(),
        unexplained=(Unexplained('heading', 0.12, 1e-7), Unexplained('rate', 0.03, 2e-4)),
        curves=[curve('heading', 'rad', HEADING, 0.08 * DEGREE * np.sin(3.0 * HEADING), 0.0)])


def bare():
    return replace(extended(), gain=None, curves=[], heading=None, noise_curve=None, trace=None)


def several():
    """Return a diagnosis with many causes, of the log, the reference and the gyro."""
    offset = Estimate(0.0201, (0.0198, 0.0204), 's')
    cubic = Estimate(-2.1e-3, (-2.4e-3, -1.8e-3), 's²/rad²')
    warm = {'warm_up': Estimate(0.3 * DEGREE, (0.2 * DEGREE, 0.4 * DEGREE), 'rad/s'),
            'time_constant': Estimate(240.0, (180.0, 330.0), 's')}
    found = (temperature_finding(()), Finding('time_offset', 'The stamps of the output come late.',
                                              {'time_offset': offset}, 0.0, 1e-4, ('bandwidth',),
                                              'reverse the motion faster than once in two seconds',
                                              'The output lags the encoder.'),
             Finding('cubic_nonlinearity', CATALOGUE['cubic_nonlinearity'].cause,
                     {'cubic_nonlinearity': cubic}, 3e-4, 5e-4, along='rate'),
             Finding('warm_up', 'The bias settles after power-on.', warm, 2e-5),
             Finding('dropped_samples', 'Samples are missing.',
                     {'dropped_samples': Estimate(123.0, (123.0, 123.0), '1')}, 1e-12,
                     evidence='123 samples are missing in 40 gaps.'))
    frequency = np.geomspace(0.01, 50.0, 40)
    amplitude = 1e-4 / np.sqrt(frequency)
    spectrum = Curve('frequency', 'Hz', frequency,
                     np.where(np.arange(40) == 30, 2e-3, 2.0 * amplitude), 2.0 * amplitude,
                     amplitude)
    return replace(extended(), findings=found, curves=[*extended().curves, spectrum],
                   unexplained=(Unexplained('frequency', 0.004, 0.002),), logs=('a.csv', 'b.csv'))


def hostile():
    found = replace(temperature_finding((HOSTILE,)), effect=HOSTILE, cause=HOSTILE,
                    separate_by=HOSTILE, evidence=HOSTILE, along=HOSTILE,
                    parameters={HOSTILE: Estimate(1.0, (0.5, 1.5), HOSTILE)})
    whole = extended()
    model = replace(whole.model, gyro={'name': HOSTILE},
                    origin={'file': HOSTILE.replace('\udcff', '')})
    gain = replace(whole.gain, held_out=HOSTILE)
    return replace(whole, findings=(found,), unexplained=(Unexplained(HOSTILE, 0.1, 0.01),),
                   logs=(HOSTILE,), gain=gain,
                   remarks=(HOSTILE, '$title $body'), cannot_show={HOSTILE: HOSTILE}, model=model,
                   curves=[replace(whole.curves[0], along=HOSTILE, unit=HOSTILE)])


def holes():
    whole, missing = extended(), np.full(24, np.nan)
    found = replace(temperature_finding(), p_value=np.nan, minimum_detectable=None,
                    parameters={'bias_temperature': Estimate(1e-4, (-np.inf, np.inf), 'rad/s/K'),
                                'k': Estimate(0.0, (0.0, 0.0), 's')})
    some = np.where(np.arange(24) % 5 == 0, np.nan, whole.curves[0].before)
    curves = [replace(whole.curves[0], before=some, deviation=missing),
              replace(whole.curves[0], before=missing, after=missing),
              Curve('time', 's', np.array([]), np.array([]), np.array([]), np.array([]))]
    return replace(whole, findings=(found,), curves=curves,
                   heading=Curve('time', 's', *np.zeros((3, 1))))


MADE = {each.__name__: each
        for each in (adequate, extended, unexplained, bare, several, hostile, holes)}


@pytest.fixture(params=MADE, scope='module')
def made(request):
    return MADE[request.param]()


class Page(HTMLParser):
    """Read a page strictly: every element closed, in order; lists elements and attributes."""

    EMPTY = {'meta', 'br'}

    def __init__(self, text):
        super().__init__()
        self.open, self.elements, self.texts = [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f'left open: {self.open}'

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        self.open += [] if tag in self.EMPTY else [tag]

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, (tag, self.getpos())

    def handle_data(self, data):
        self.texts.append(data)

    @property
    def text(self):
        return ' '.join(' '.join(self.texts).split())


@pytest.fixture(scope='module')
def page(made):
    return Page(render_report(made))


def test_the_page_is_well_formed_and_has_each_name_once(page):
    names = [attributes['id'] for _, attributes in page.elements if 'id' in attributes]
    assert len(names) == len(set(names))
    assert {tag for tag, _ in page.elements} >= {'h1', 'main', 'section', 'style'}


def test_the_page_refers_to_nothing_outside_and_allows_itself_no_network(page):
    for tag, attributes in page.elements:
        assert tag not in ('img', 'link', 'iframe', 'object', 'embed', 'base', 'form', 'a')
        assert not {'src', 'href', 'srcset', 'action'} & set(attributes)
        assert not re.search(r'url\([^#]', ' '.join(map(str, attributes.values())))
        assert not any(name.startswith('on') for name in attributes)
    policy, = [attributes['content'] for _, attributes in page.elements
               if attributes.get('http-equiv')]
    assert policy.startswith("default-src 'none';")


def test_texts_of_others_stay_texts():
    text = render_report(hostile())
    page = Page(text)
    assert 'script' not in [tag for tag, _ in page.elements]
    assert '<script>document.title' in page.text and '$title $body' in page.text
    assert not any(ord(each) < 32 and each != '\n' for each in text)
    text.encode()  # what cannot be said in UTF-8 could not be written


def test_no_number_is_written_as_a_computer_says_it(page):
    text = page.text.split('The model', 1)[0]
    assert not [word for word in ('nan', 'inf ', 'None', 'e-0', 'np.float') if word in text]


def test_every_chart_has_words_and_a_table_of_its_values(page, made):
    tags = [tag for tag, _ in page.elements]
    charts = [attributes for tag, attributes in page.elements if tag == 'svg']
    assert tags.count('figure') == tags.count('caption') == len(charts)
    assert bool(charts) == bool(made.curves)
    assert all(each['role'] == 'img' and each['aria-label'] for each in charts)


def test_without_matplotlib_the_values_are_there_without_pictures(monkeypatch):
    tables = render_report(extended()).count('<table')
    monkeypatch.setattr(report, 'find_spec', lambda name: None)
    text = render_report(extended())
    assert '<svg' not in text and text.count('<table') == tables
    assert 'matplotlib is not installed' in text


def test_the_finding_stands_on_top_and_is_the_same_for_the_terminal(page, made):
    if made.logs != (HOSTILE,):
        assert all(sentence in page.text for sentence in headline(made))
    assert len(headline(made)) == 2
    assert ' '.join(terminal_lines(made)).replace('\n', ' ').startswith(headline(made)[0])


def test_a_set_is_named_with_the_experiment_that_distinguishes_it():
    text = ' '.join(' '.join(terminal_lines(extended())).split())
    assert 'bias temperature or rate ramp, which these data cannot distinguish' in text
    assert 'To distinguish them: heat and cool the gyro within one log.' in text


def test_among_several_causes_a_set_is_in_brackets_and_sizes_are_in_data_sheet_units():
    assert 'time offset (or bandwidth), cubic nonlinearity and 2 more' in headline(several())[0]
    text = ' '.join(terminal_lines(several()))
    assert '20.10 (19.80 to 20.40) ms' in text and 'deg/s/K' in text and 'rad' not in text


def test_what_a_reference_with_errors_does_not_establish_is_not_said_to_be_noise():
    erring = replace(adequate(), reference=Reference('course', '', {'reference': 1.0 * DEGREE}))
    suspected = mark_suspected(extended().findings[0])
    assert headline(adequate())[0] == 'Simulation and measurement differ by no more than noise.'
    assert headline(erring)[0] == ('No difference is established beyond the errors of the '
                                   'reference.')
    assert headline(replace(adequate(), findings=(suspected,)))[0] == (
        f'No difference is established; suspected: {suspected.effect.replace("_", " ")}.')


@pytest.mark.parametrize('value, interval, unit, words', [
    (0.0201, (0.0198, 0.0204), 's', '20.10 (19.80 to 20.40) ms'),
    (-0.0123, (-0.0130, -0.0116), '1', '−1.230 (−1.300 to −1.160) %'),
    (1.5e-5, (1e-5, 2e-5), '1', '15.0 (10.0 to 20.0) ppm'),
    (-2.1e-3, (-2.4e-3, -1.8e-3), 's²/rad²', '−6.40 (−7.31 to −5.48) × 10⁻⁷ s²/deg²'),
    (np.pi / 180.0, (0.0, np.pi / 90.0), '(rad/s)/(m/s²)', '1.0 (0.0 to 2.0) (deg/s)/(m/s²)'),
    (1.0, (0.9, 1.1), 's/rad', '0.0175 (0.0157 to 0.0192) s/deg'),
    (0.1, (0.1, 0.1), 'V', '0.1 V'), (0.5, (-np.inf, np.inf), 'Hz', '0.5 (−∞ to ∞) Hz')])
def test_an_estimate_is_written_with_the_digits_of_its_interval(value, interval, unit, words):
    assert str(format_quantity(Estimate(value, interval, unit))) == words


@pytest.mark.parametrize('interval, words',
                         [((0.01, 0.02), 'reduces'), ((-0.01, 0.02), 'includes zero'),
                          ((-0.02, -0.01), 'increases'), (None, 'no interval')])
def test_a_gain_is_called_what_it_is(interval, words):
    gain = extended().gain
    changed = replace(bare(), gain=replace(gain, heading=replace(gain.heading, interval=interval)))
    assert words in headline(changed)[1] and words in Page(render_report(changed)).text


def test_lines_for_a_terminal_are_not_too_long(made):
    if made.logs != (HOSTILE,):
        assert max(len(line) for text in terminal_lines(made) for line in text.split('\n')) <= 120


WIDTHS = {'watch': 320, 'phone': 390, 'desk': 1280}
#: For each frame: its width, that of its content, elements that reach beyond its right edge except
#: inside scrolling boxes, and the least contrast of texts, letters of charts, and strokes (WCAG 2,
#: 1.4.3 and 1.4.11).
MEASURE = """
const light = colour => { const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map(Number)
  .map(each => each / 255).map(each => each > 0.04045 ? ((each + 0.055) / 1.055) ** 2.4
                                                      : each / 12.92);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
const behind = each => { const colour = getComputedStyle(each).backgroundColor;
  return colour.startsWith('rgba') && each.parentElement ? behind(each.parentElement) : colour; };
const contrast = (a, b) => { const [low, high] = [light(a), light(b)].sort((x, y) => x - y);
  return (high + 0.05) / (low + 0.05); };
window.onerror = message => { document.body.textContent = JSON.stringify(message); };
onload = () => { document.body.textContent = JSON.stringify(
  [...document.querySelectorAll('iframe')].map(frame => { const page = frame.contentDocument;
    const least = (selector, name) => Math.min(99, ...[...page.querySelectorAll(selector)]
      .filter(each => getComputedStyle(each)[name] !== 'none')
      .map(each => contrast(getComputedStyle(each)[name], behind(each))));
    return {width: frame.clientWidth, content: page.documentElement.scrollWidth,
      beyond: [...page.querySelectorAll('body *')].filter(each => !each.closest('.scroll, svg')
        && each.getBoundingClientRect().right > frame.clientWidth + 0.5).map(
        each => each.outerHTML.slice(0, 80)),
      paper: getComputedStyle(page.body).backgroundColor, contrasts: [
        least('p, h1, h2, h3, li, td, th, summary, figcaption, pre', 'color'),
        least('svg text', 'fill'), least('svg path[style*="var(--after)"]', 'stroke'),
        least('svg path[style*="var(--before)"]', 'stroke')]}; })); };
"""


def browse(folder, *words):
    if not CHROMIUM.exists():
        pytest.skip(f'{CHROMIUM} is missing: install the package chromium')
    command = [CHROMIUM, '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
               '--no-first-run', '--disable-background-networking',
               f'--user-data-dir={folder / "profile"}', *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=240).stdout


def measured(folder, pages, widths, dark=False):
    """Return the measures of pages in frames of these widths."""
    frames = ''.join(f'<iframe style="width: {width}px; height: 800px; border: 0" '
                     f'srcdoc="{escape(page)}"></iframe>' for page in pages for width in widths)
    path = folder / 'frames.html'
    path.write_text(f'<html><meta charset="utf-8"><body>{frames}<script>{MEASURE}</script></body>'
                    '</html>', encoding='utf-8')
    text = browse(folder, f'--blink-settings=preferredColorScheme={0 if dark else 1}',
                  '--dump-dom', path.as_uri())
    return json.loads(unescape(re.search(r'<body>(.*)</body>', text, re.DOTALL)[1]))


def test_the_page_fits_each_screen(tmp_path):
    pages = [render_report(make()) for make in (several, hostile, holes)]
    found = measured(tmp_path, pages, WIDTHS.values())
    assert [each['width'] for each in found] == list(WIDTHS.values()) * len(pages)
    for each in found:
        assert each['content'] <= each['width'] and not each['beyond'], each


@pytest.mark.parametrize('dark', [False, True], ids=['light', 'dark'])
def test_everything_can_be_read_in_light_and_in_dark(tmp_path, dark):
    (found,) = measured(tmp_path, [render_report(extended())], [WIDTHS['phone']], dark)
    assert (found['paper'] == 'rgb(20, 24, 27)') == dark
    text, letters, *strokes = found['contrasts']
    assert text >= 4.5 and letters >= 4.5 and min(strokes) >= 3.0
