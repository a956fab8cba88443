from humansim_ros.ros.challenge.options import ChallengeOptions as ChallengeOptions
from humansim_ros.ros.challenge.report import show_table as show_table
from humansim_ros.ros.challenge.report import write_pages as write_pages
from humansim_ros.ros.challenge.results import CaseResult as CaseResult
from humansim_ros.ros.challenge.results import Report as Report
from humansim_ros.ros.challenge.run import open_report as open_report
from humansim_ros.ros.challenge.run import run_challenge as run_challenge
from humansim_ros.ros.challenge.suite import load_suite as load_suite
