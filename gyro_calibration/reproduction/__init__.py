"""
Published numbers of the sources of this package beside ours, and contradictions in the sources.

One file a source; `finding` holds what they share. Published numbers are in the units of their
source. Each has a function ``reproduce(generator, runs, progress)``: the source of the noise; the
number of simulated drives or turntable runs, of which calibrations on a rate table are a
twentieth; and a display of how many are done.

"""

from gyro_calibration.reproduction import bot_thoughts, hong_park, ojeda_chung_borenstein

#: In the order of their years.
SOURCES = {'ojeda': ojeda_chung_borenstein.reproduce, 'hong_park': hong_park.reproduce,
           'bot_thoughts': bot_thoughts.reproduce}
