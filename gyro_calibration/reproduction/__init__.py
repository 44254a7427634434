"""
The sources of this package, worked through again: their numbers beside ours, and where they contradict themselves.

One file a source; `finding` holds what they share. Published numbers stand in the units of their source.

"""

from gyro_calibration.reproduction import bot_thoughts, hong_park, ojeda_chung_borenstein

#: In the order of their years; each has ``reproduce(generator, runs, progress)``.
SOURCES = {'ojeda': ojeda_chung_borenstein.reproduce, 'hong_park': hong_park.reproduce, 'bot_thoughts': bot_thoughts.reproduce}
