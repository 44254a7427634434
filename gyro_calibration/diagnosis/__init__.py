# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Diagnosis: what a simulation of a gyro gets wrong, why, and what extending its model improves.

Reading order, each imports only from those before it: `findings` (what is found, as records, and
the rules by which causes are named), `causes` (that can be named, and experiments that distinguish
them), `gates` (which logs are refused, whether gyro and reference belong together, and the kind of
the reference), `data_quality` (of a record: lost, repeated and outlying samples, codes and
limits), `replay` (of a log, and the spectrum of its noise), `candidates` (columns of causes, and
of what has no name), `regression` (of logs on causes, under every noise), `scans` (for tones,
steps and slips), `search` (for causes, and their confirmation), `words` (numbers and findings for
people), `residuals` (their noise and curves), `extended_model` (and its gain on what was held
out), `span_search` (the search over spans), `noisy_reference` (a log as spans, where the reference
limits what is known), `reference_lag` (of a motion that follows its reference), `table_diagnosis`
(of a rate table), `log_diagnosis` (of logs, in order), `report` (the page).
"""
