"""What measures the rest: commands, run from the repository's root by `python -m benchmarks.NAME --help`.

`policies.py` and `records.py` are no commands; the others share them.

| command | what it does |
|---|---|
| `run_seeds` | trains the lists in `benchmarks/trainings/` and publishes them |
| `same_training` | shows whether a change has touched the learning, to the bit |
| `speed` | times environments, and updates on a CPU or a GPU |
| `memory` | prints the tables of results/memory and results/ablation |
| `attention` | draws what the attention heads look at |
| `peers`, `sb3_ppo` | Stable-Baselines3 on the same problems: the table, one training |
| `gradient` | trains by the gradient through the physics |
| `decision` | times a policy's decision by onnxruntime and by torch |
| `page_flights` | compares a page's flights with Python's |
| `robustness` | kills runs, damages files, gives absurd flags and actions |
"""
