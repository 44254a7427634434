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

Reading order, each imports only from those before it: `findings` (what is found, as records),
`causes` (that can be named), `expected_output` (by the reference), `quantization` (codes and
limits of an output), `repeated_samples`, `outliers`, `unit_confusion`, `gates` (whether gyro and
reference belong together), `input_validation` (which logs are refused), `data_quality` (of a
record), `reference` (its kind), `spectrum` (of the noise), `replay` (of a log), `candidates`
(columns of causes), `generic_terms` (of what has no name), `noise_likelihood` (with a cause, under
every noise), `regression_problem` (logs as a regression), `search` (for causes), `units` (of
people), `experiments` (that distinguish causes), `fitted_values` (of what was found),
`noise_parameters`, `extended_model`, `cross_validation` (on what was held out), `curves` (for
people to see), `build_findings`; where the reference limits what is known, `spans` (of heading, as
a regression), `confirmation` (of causes), `noisy_reference` (the diagnosis of such a log);
`pipeline` (of a diagnosis, in order), `dwell_fit` (of what a model leaves of a rate table),
`dwell_confounders` (that dwells cannot distinguish), `dwell_structure` (what has no name),
`rate_table` (the diagnosis of a rate table), `words` (for people), `markup` (of pages), `charts`
(in pages), `report` (the page).

"""
