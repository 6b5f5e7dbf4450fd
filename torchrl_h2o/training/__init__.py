"""The experiment around a loss: environments, collection, a loop that resumes, evaluation, films, populations."""
