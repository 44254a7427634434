"""
Logs as files: what comes in, in which unit, and what is refused. The claims are those of the log format.

"""

import gzip
import math

import numpy as np
import pytest

from gyro_calibration.log import Log, LogError, read_log, write_log

DEGREE = math.pi / 180.0


def written(folder, text, name='log.csv'):
    """Return the path of a file with this text."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize('column, attribute, factor', [
    ('gyro_dps', 'output', DEGREE), ('gyro_rad_s', 'output', 1.0), ('gyro_counts', 'counts', 1.0), ('temperature_degc', 'temperature', 1.0),
    ('reference_rate_dps', 'reference_rate', DEGREE), ('reference_rate_rad_s', 'reference_rate', 1.0),
    ('reference_heading_deg', 'reference_heading', DEGREE), ('reference_heading_rad', 'reference_heading', 1.0),
    ('acceleration_mps2', 'specific_force', 1.0), ('supply_v', 'supply', 1.0), ('moving', 'moving', 1.0)])
def test_every_column_is_converted_to_si(tmp_path, column, attribute, factor):
    gyro = '' if 'gyro' in column else 'gyro_rad_s,'
    rows = ''.join(f'{"0," if gyro else ""}{value},{second}\n' for second, value in enumerate([1, 0, 2.5]))
    log = read_log(written(tmp_path, f'{gyro}{column},time_s\n{rows}'))
    assert getattr(log, attribute).tolist() == [1 * factor, 0, 2.5 * factor]
    assert log.time.tolist() == [0, 1, 2] and len(log) == 3


def test_counts_become_rates_by_the_sensitivity(tmp_path):
    log = read_log(written(tmp_path, 'gyro_counts\n100\n-50\n'), sensitivity=0.01)
    assert log.output.tolist() == [1.0, -0.5] and log.counts.tolist() == [100, -50] and log.time is None


REFUSED = {
    'empty': ('', 'line 1 is no header'),
    'only notes': ('# a\n# b\n', 'line 3 is no header'),
    'no header': ('# note\n0.0,1.0\n0.1,1.0\n', 'line 2 is no header'),
    'no gyro': ('time_s,temperature_degc\n0,1\n1,1\n', 'no gyro column among time_s,temperature_degc'),
    'two columns': ('gyro_dps,gyro_rad_s\n0,1\n1,1\n', 'columns gyro_dps and gyro_rad_s both give the output'),
    'twice the same': ('gyro_dps,gyro_dps\n0,1\n1,1\n', 'columns gyro_dps and gyro_dps both'),
    'text': ('# note\ntime_s,gyro_dps\n0,1\n1,fast\n', "line 4, column gyro_dps: 'fast' is not a number"),
    'nothing': ('time_s,gyro_dps\n0,1\n1,\n', "line 3, column gyro_dps: '' is not a number"),
    'an empty line between': ('time_s,gyro_dps\n0,1\n\n1,1\n', 'line 3 has 0 values where the header has 2'),
    'stands': ('time_s,gyro_dps\n0,1\n1,1\n1,1\n', 'line 4, column time_s: 1 s does not come after 1 s'),
    'goes back': ('time_s,gyro_dps\n0,1\n1,1\n0.5,1\n', 'line 4, column time_s: 0.5 s does not come after 1 s'),
    'lost time': ('time_s,gyro_dps\n0,1\nnan,1\n2,1\n', 'line 3, column time_s: nan is not a finite number'),
    'infinite': ('time_s,gyro_dps\n0,1\n1,-inf\n', 'line 3, column gyro_dps: -inf is not a finite number'),
    'infinite reference': ('gyro_dps,reference_heading_deg\n0,1\n1,inf\n', 'line 3, column reference_heading_deg'),
    'one row': ('gyro_dps\n0\n', '1 rows of data'),
    'short row': ('time_s,gyro_dps\n0,1\n1\n', 'line 3 has 1 values where the header has 2'),
    'long row': ('time_s,gyro_dps\n0,1\n1,2,3\n', 'line 3 has 3 values where the header has 2'),
    'binary': (bytes(range(256)), 'cannot be read as a log'),
    'one endless field': ('gyro_dps\n' + '1' * 200000 + '\n1\n', 'cannot be read as a log'),
}


@pytest.mark.parametrize('text, message', REFUSED.values(), ids=REFUSED)
def test_what_is_no_log_is_refused_with_file_row_and_column(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(LogError) as refused:
        read_log(path)
    assert str(refused.value).startswith(f'{path}: ') and message in str(refused.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(LogError, match='nothing.csv'):
        read_log(tmp_path / 'nothing.csv')


@pytest.mark.parametrize('cut', [0, 5, -3])
def test_a_broken_compressed_file_is_refused(tmp_path, cut):
    whole = gzip.compress(b'gyro_dps\n1\n2\n')
    with pytest.raises(LogError, match='log.csv.gz'):
        read_log(written(tmp_path, whole[:cut] + b'x' * (cut == 0), 'log.csv.gz'))


def test_a_lost_reference_is_nan(tmp_path):
    log = read_log(written(tmp_path, 'gyro_dps,reference_rate_dps,reference_heading_deg\n1,nan,nan\n2,180,NaN\n'))
    assert np.isnan(log.reference_rate).tolist() == [True, False] and np.isnan(log.reference_heading).all()


def test_empty_lines_at_the_end_are_no_rows(tmp_path):
    assert len(read_log(written(tmp_path, 'gyro_dps\n1\n2\n\n\n'))) == 2


def test_a_byte_order_mark_hides_no_column(tmp_path):
    assert read_log(written(tmp_path, '\ufefftime_s,gyro_dps\r\n0,1\r\n1,1\r\n')).time.tolist() == [0, 1]


@pytest.mark.parametrize('name', ['log.csv', 'log.csv.gz'])
def test_a_log_is_read_back_as_it_was_written(tmp_path, name):
    generator = np.random.default_rng(0)
    names = ['output', 'counts', 'temperature', 'reference_rate', 'reference_heading', 'specific_force', 'supply', 'moving']
    log = Log(time=np.cumsum(generator.random(50)), **{quantity: generator.normal(size=50) for quantity in names}, notes=('a', 'b, c'))
    write_log(tmp_path / name, log)
    again = read_log(tmp_path / name)
    assert again.notes == log.notes
    assert all(np.array_equal(getattr(again, quantity), getattr(log, quantity)) for quantity in ['time', *names])


def test_columns_that_are_not_ours_are_kept(tmp_path):
    path = written(tmp_path, '# note\noperator,gyro_dps,lap\nAnn,1,"1, 2"\nBob,2,\n')
    write_log(path, read_log(path), {'heading_rad': np.array([0.5, 1.0])})
    again = read_log(path)
    assert again.others == {'operator': ('Ann', 'Bob'), 'lap': ('1, 2', ''), 'heading_rad': ('0.5', '1.0')}
    assert path.read_text().splitlines()[0] == '# note'
