"""
The sources of this package, worked through again: their numbers beside ours, and where they contradict themselves.

One file a source; `finding` holds what they share. Published numbers stand in the units of their source. Each has a function
``reproduce(generator, runs, progress)``: the source of the noise; how often a drive, or a turntable, is simulated, a calibration on a rate
table a twentieth as often; and what shows how many of them are done.

"""

from gyro_calibration.reproduction import bot_thoughts, hong_park, ojeda_chung_borenstein

#: In the order of their years.
SOURCES = {'ojeda': ojeda_chung_borenstein.reproduce, 'hong_park': hong_park.reproduce, 'bot_thoughts': bot_thoughts.reproduce}
