"""The verdict on a fit: whether its model explains the log and is complete, and the reasons in words."""

from jaxid.results.verdict.judgement import Judgement as Judgement
from jaxid.results.verdict.judgement import judge as judge
