"""References: every publication and data set that definitions, rules, models and figures come from, in full.

docs/references.md is derived from this list; other generated pages link to it by `link_references`.
"""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Reference:
    """A publication or a data set.

    Args:
        name: authors and year as texts cite them, for example `Deo and Trivedi (2018)`.
        used_for: what tracklake takes from it.
        doi: digital object identifier; empty without one.
    """

    name: str
    text: str
    used_for: str
    doi: str = ""
    url: str = ""

    @property
    def address(self) -> str:
        """Web address; empty where none is known."""
        return f"https://doi.org/{self.doi}" if self.doi else self.url

    @property
    def full(self) -> str:
        """Full reference in one line, with its address where there is one."""
        return f"{self.text} {self.address}".rstrip()

    @property
    def anchor(self) -> str:
        """Anchor of its heading in docs/references.md."""
        return re.sub(r"[^a-z0-9 -]", "", self.name.lower()).replace(" ", "-")


HAMALAINEN = Reference(
    "Hamalainen (2020)",
    "Hamalainen, D. (2020). Validation of a Machine-Learning Based Vehicle Trajectory Prediction Model with Improved "
    "Data and Data Management. Papers in Resource Analysis 23, Saint Mary's University of Minnesota.",
    "error counts and speeds of NGSIM and highD, late starts, the flow-balanced split, excluded subsets, scores of "
    "convolutional social pooling with maneuvers",
)
NGSIM = Reference(
    "NGSIM (2016)",
    "U.S. Department of Transportation Federal Highway Administration (2016). Next Generation Simulation (NGSIM) "
    "Vehicle Trajectories and Supporting Data.",
    "the data set, its units and meanings",
    doi="10.21949/1504477",
)
TGSIM = Reference(
    "Ammourah et al. (2024)",
    "Ammourah, R., Beigi, P., Fan, B., Hamdar, S. H., Hourdos, J., Hsiao, C.-C., James, R., Khajeh-Hosseini, M., "
    "Mahmassani, H. S., Monzer, D., Radvand, T., Talebpour, A., Yousefi, M., Zhang, Y. (2024). Introduction to the "
    "Third Generation Simulation Dataset: Data Collection and Trajectory Extraction. Transportation Research Record.",
    "the TGSIM data set, its units and meanings",
    doi="10.1177/03611981241257257",
)
GLOUDEMANS = Reference(
    "Gloudemans et al. (2023)",
    "Gloudemans, D., Wang, Y., Ji, J., Zachar, G., Barbour, W., Hall, E., Cebelak, M., Smith, L., Work, D. B. (2023). "
    "I-24 MOTION: An instrument for freeway traffic science. Transportation Research Part C 155, 104311.",
    "the I-24 MOTION data set, its units and meanings",
    doi="10.1016/j.trc.2023.104311",
)
KRAJEWSKI = Reference(
    "Krajewski et al. (2018)",
    "Krajewski, R., Bock, J., Kloeker, L., Eckstein, L. (2018). The highD Dataset: A Drone Dataset of Naturalistic "
    "Vehicle Trajectories on German Highways for Validation of Highly Automated Driving Systems. IEEE International "
    "Conference on Intelligent Transportation Systems (ITSC), 2118-2125.",
    "the highD data set and its format",
    doi="10.1109/ITSC.2018.8569552",
)
MOERS = Reference(
    "Moers et al. (2022)",
    "Moers, T., Vater, L., Krajewski, R., Bock, J., Zlocki, A., Eckstein, L. (2022). The exiD Dataset: A Real-World "
    "Trajectory Dataset of Highly Interactive Highway Scenarios in Germany. IEEE Intelligent Vehicles Symposium (IV), "
    "958-964.",
    "the exiD data set and its format",
    doi="10.1109/IV51971.2022.9827305",
)
BOCK = Reference(
    "Bock et al. (2020)",
    "Bock, J., Krajewski, R., Moers, T., Runde, S., Vater, L., Eckstein, L. (2020). The inD Dataset: A Drone Dataset "
    "of Naturalistic Road User Trajectories at German Intersections. IEEE Intelligent Vehicles Symposium (IV), "
    "1929-1934.",
    "the inD data set and its format",
    doi="10.1109/IV47402.2020.9304839",
)
KRAJEWSKI_2020 = Reference(
    "Krajewski et al. (2020)",
    "Krajewski, R., Moers, T., Bock, J., Vater, L., Eckstein, L. (2020). The rounD Dataset: A Drone Dataset of Road "
    "User Trajectories at Roundabouts in Germany. IEEE International Conference on Intelligent Transportation Systems "
    "(ITSC), 1-6.",
    "the rounD data set and its format",
    doi="10.1109/ITSC45102.2020.9294728",
)
COIFMAN = Reference(
    "Coifman and Li (2017)",
    "Coifman, B., Li, L. (2017). A critical evaluation of the Next Generation Simulation (NGSIM) vehicle trajectory "
    "dataset. Transportation Research Part B 105, 362-377.",
    "errors known in NGSIM: negative gaps and overlapping vehicles; I-80 tracked again, with lanes in place of lateral "
    "positions",
    doi="10.1016/j.trb.2017.09.018",
)
PUNZO = Reference(
    "Punzo, Borzacchiello and Ciuffo (2011)",
    "Punzo, V., Borzacchiello, M. T., Ciuffo, B. (2011). On the assessment of vehicle trajectory data accuracy and "
    "application to the Next Generation SIMulation (NGSIM) program data. Transportation Research Part C 19(6), "
    "1243-1262.",
    "internal consistency, implausible accelerations and jerk",
    doi="10.1016/j.trc.2010.12.007",
)
EDIE = Reference(
    "Edie (1963)",
    "Edie, L. C. (1963). Discussion of traffic stream measurements and definitions. Proceedings of the Second "
    "International Symposium on the Theory of Traffic Flow, 139-154.",
    "flow, density and speed over a region of time and space",
)
DEO = Reference(
    "Deo and Trivedi (2018)",
    "Deo, N., Trivedi, M. M. (2018). Convolutional Social Pooling for Vehicle Trajectory Prediction. IEEE/CVF CVPR "
    "Workshops, 1468-1476.",
    "protocol csp, the models v-lstm, cs-lstm and cs-lstm-m, the format of `export csp` "
    "(code: https://github.com/nachiket92/conv-social-pooling)",
    doi="10.1109/CVPRW.2018.00196",
)
KIM = Reference(
    "Kim et al. (2020)",
    "Kim, H., Kim, D., Kim, G., Cho, J., Huh, K. (2020). Multi-Head Attention based Probabilistic Vehicle Trajectory "
    "Prediction. IEEE Intelligent Vehicles Symposium, 1720-1725.",
    "protocol mha-2020 and the models attention-h2, -h4 and -h8; its split is unpublished",
    url="https://arxiv.org/abs/2004.03842",
)
CHOI = Reference(
    "Choi et al. (2021)",
    "Choi, D., Yim, J., Baek, M., Lee, S. (2021). Machine Learning-Based Vehicle Trajectory Prediction Using V2V "
    "Communications and On-Board Sensors. Electronics 10(4), 420.",
    "protocols grid-2021 and v2v-2021, lane changes by random forest, grid cells, stacked-lstm and "
    "lstm-encoder-decoder; 932 trajectories of the authors' own vehicles",
    doi="10.3390/electronics10040420",
)
MESSAOUD = Reference(
    "Messaoud et al. (2021)",
    "Messaoud, K., Yahiaoui, I., Verroust-Blondet, A., Nashashibi, F. (2021). Attention Based Vehicle Trajectory "
    "Prediction. IEEE Transactions on Intelligent Vehicles 6(1), 175-185.",
    "published scores on NGSIM",
    doi="10.1109/TIV.2020.2991952",
)
CHEN = Reference(
    "Chen et al. (2022)",
    "Chen, X., Zhang, H., Zhao, F., Hu, Y., Tan, C., Yang, J. (2022). Intention-Aware Vehicle Trajectory Prediction "
    "Based on Spatial-Temporal Dynamic Attention Network for Internet of Vehicles. IEEE Transactions on Intelligent "
    "Transportation Systems 23(10), 19471-19483.",
    "published scores on NGSIM",
    doi="10.1109/TITS.2022.3170551",
)
BAR_SHALOM = Reference(
    "Bar-Shalom, Li and Kirubarajan (2001)",
    "Bar-Shalom, Y., Li, X. R., Kirubarajan, T. (2001). Estimation with Applications to Tracking and Navigation. "
    "Wiley, section 6.2.2.",
    "the model kalman-cv, filtered tracks",
    doi="10.1002/0471221279",
)
SCHUBERT = Reference(
    "Schubert, Richter and Wanielik (2008)",
    "Schubert, R., Richter, E., Wanielik, G. (2008). Comparison and evaluation of advanced motion models for vehicle "
    "tracking. 11th International Conference on Information Fusion.",
    "the model ctrv",
)
GRAVES = Reference(
    "Graves (2013)",
    "Graves, A. (2013). Generating Sequences With Recurrent Neural Networks.",
    "outputs as bivariate normal densities",
    url="https://arxiv.org/abs/1308.0850",
)
TREIBER_2013 = Reference(
    "Treiber and Kesting (2013)",
    "Treiber, M., Kesting, A. (2013). Microscopic Calibration and Validation of Car-Following Models: A Systematic "
    "Approach. Procedia - Social and Behavioral Sciences 80, 922-939.",
    "driving regimes of car following",
    doi="10.1016/j.sbspro.2013.05.050",
)
SHARMA = Reference(
    "Sharma, Zheng and Bhaskar (2018)",
    "Sharma, A., Zheng, Z., Bhaskar, A. (2018). A pattern recognition algorithm for assessing trajectory completeness. "
    "Transportation Research Part C 96, 432-457.",
    "driving regimes of car following",
)
VOGEL = Reference(
    "Vogel (2002)",
    "Vogel, K. (2002). What characterizes a free vehicle in an urban area? Transportation Research Part F 5(1), 15-29.",
    "the time headway beyond which a vehicle is free",
)
TOLEDO = Reference(
    "Toledo and Zohar (2007)",
    "Toledo, T., Zohar, D. (2007). Modeling Duration of Lane Changes. Transportation Research Record 1999, 71-78.",
    "begin and end of a lane change",
    doi="10.3141/1999-08",
)
HAYWARD = Reference(
    "Hayward (1972)",
    "Hayward, J. C. (1972). Near-miss determination through use of a scale of danger. Highway Research Record 384, "
    "24-34.",
    "time to collision",
)
ALLEN = Reference(
    "Allen, Shin and Cooper (1978)",
    "Allen, B. L., Shin, B. T., Cooper, P. J. (1978). Analysis of Traffic Conflicts and Collisions. Transportation "
    "Research Record 667, 67-74.",
    "post-encroachment time",
)
COOPER = Reference(
    "Cooper and Ferguson (1976)",
    "Cooper, D. F., Ferguson, N. (1976). Traffic studies at T-junctions: a conflict simulation record. Traffic "
    "Engineering and Control 17, 306-309.",
    "deceleration rate to avoid a crash",
)
ALMQVIST = Reference(
    "Almqvist et al. (1991)",
    "Almqvist, S., Hyden, C., Risser, R. (1991). Use of speed limiters in cars for increased safety and a better "
    "environment. Transportation Research Record 1318, 34-39.",
    "deceleration rate to avoid a crash",
)
ARCHER = Reference(
    "Archer (2005)",
    "Archer, J. (2005). Indicators for traffic safety assessment and prediction and their application in "
    "micro-simulation modelling. Royal Institute of Technology, Stockholm.",
    "the threshold of the deceleration rate to avoid a crash",
)
GETTMAN = Reference(
    "Gettman et al. (2008)",
    "Gettman, D., Pu, L., Sayed, T., Shelby, S. (2008). Surrogate Safety Assessment Model and Validation: Final "
    "Report. FHWA-HRT-08-051, Federal Highway Administration.",
    "the threshold of time to collision",
)
RAKHA = Reference(
    "Rakha, Snare and Dion (2004)",
    "Rakha, H., Snare, M., Dion, F. (2004). Vehicle Dynamics Model for Estimating Maximum Light-Duty Vehicle "
    "Acceleration Levels. Transportation Research Record 1883, 40-49.",
    "models of how acceleration falls with speed",
)
RAJAMANI = Reference(
    "Rajamani (2012)",
    "Rajamani, R. (2012). Vehicle Dynamics and Control. Springer, second edition.",
    "the angle between a body and its motion",
    doi="10.1007/978-1-4614-1433-9",
)
DAGANZO = Reference(
    "Daganzo (1997)",
    "Daganzo, C. F. (1997). Fundamentals of Transportation and Traffic Operations. Pergamon.",
    "conservation of vehicles between cross sections",
)

REFERENCES = (
    *(HAMALAINEN, NGSIM, KRAJEWSKI, TGSIM, GLOUDEMANS, COIFMAN, PUNZO, EDIE, DEO, KIM, CHOI, MESSAOUD, CHEN),
    *(BAR_SHALOM, SCHUBERT, GRAVES, TREIBER_2013, SHARMA, VOGEL, TOLEDO, HAYWARD, ALLEN, COOPER, ALMQVIST, ARCHER),
    *(GETTMAN, RAKHA, RAJAMANI, DAGANZO, MOERS, BOCK, KRAJEWSKI_2020),
)
"""All references, the one whose method tracklake builds on first."""


def link_references(text: str, page: str = "references.md") -> str:
    """Turn the names of references in a Markdown text into links to their entries on docs/references.md."""
    for reference in REFERENCES:
        text = text.replace(reference.name, f"[{reference.name}]({page}#{reference.anchor})")
    return text


def find_references(text: str) -> list[Reference]:
    """Find the references that a text cites by name, in the order of REFERENCES."""
    return [reference for reference in REFERENCES if reference.name in text]
