"""The experiment around a loss: environments, collection, a resumable loop, evaluation, films, populations."""
