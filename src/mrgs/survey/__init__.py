"""What is known of the day on which the photos were taken, and cannot be read from them."""

from mrgs.survey.survey import SURVEY_FILE, Side, Survey, read_survey, write_survey

__all__ = ["SURVEY_FILE", "Side", "Survey", "read_survey", "write_survey"]
