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

Reading order, each imports only from those before it: `finding` (what is found, as records),
`causes` (that can be named), `compared` (output and reference), `codes` (of a digital output),
`stuck` (samples), `wild` (samples), `factors` (of units), `gates` (whether gyro and reference
belong together), `door` (where logs are refused), `hygiene` (of a record), `reference` (its kind),
`spectrum` (of the noise), `replay` (of a log), `candidates` (columns of causes), `probes` (of what
has no name), `evidence` (for causes), `field` (logs as a regression), `search` (for causes),
`units` (of people), `candidate_experiments` (that distinguish causes), `outcome` (of a search, in
values), `figures` (of noise), `extension` (of the model), `gain` (on what was held out), `curves`
(for people to see), `naming` (of findings); where the reference limits what is known, `regression`
(on spans), `confirmation` (of causes), `noisy_reference` (the diagnosis of such a log); `steps`
(of a diagnosis, in order), `dwell_fit` (of what a model leaves of a rate table), `dwell_sets`
(that dwells cannot part), `dwell_rest` (what has no name), `dwell_gain` (on sweeps left out),
`table` (the diagnosis of a rate table), `words` (for people), `markup` (of pages), `charts` (in
pages), `report` (the page).

"""
