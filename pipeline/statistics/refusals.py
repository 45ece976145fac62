"""Why a floor is refused, in words for people. What does not belong here: when (`floors`)."""

TOO_FAR = (
    "the nearest states differ too much: extrapolation to distance zero would take away {:.0f} % of what they show"
)
NOT_EXPLAINED = (
    "the regression that takes the smooth part away is not good enough here: its squared error on held-out episodes is {:.1f} "
    "times the estimate"
)
CONTRADICTED = (
    "two ways of extrapolating contradict each other: without the regression that takes the smooth part away, clearly less of "
    "the difference between neighbours would be disagreement"
)
TOO_SMALL = (
    "people disagree by less than {:.0f} % of the actions' deviation, if at all: too little to tell it from zero"
)
A_JUMP = (
    "the mean action may jump from state to state (as where a gripper closes): a jump could make up {:.0f} % of the estimate, and "
    "the data cannot tell"
)
