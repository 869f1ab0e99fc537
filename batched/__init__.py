"""The family of the ids without an optimum: any registered environment that is derived from `BatchedEnv`."""
