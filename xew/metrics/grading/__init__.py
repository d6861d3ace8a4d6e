"""From folders of videos to score tables. Steps of `evaluate`: list_jobs, open_graders, grade_episodes, write_scores."""

__all__ = ["baselines", "bundle", "grade_episodes", "list_jobs", "open_graders", "scores", "summary", "write_scores"]
