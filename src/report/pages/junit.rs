//! A report as JUnit XML, and as the annotations of GitHub's runners.

use quick_junit::{NonSuccessKind, Report as Suites, TestCase, TestCaseStatus, TestSuite};

use crate::report::model::{Breach, Report};

/// The report as JUnit XML: a suite an asset, with a case for its build and one for each limit that is past.
///
/// # Errors
/// When it cannot be written as XML.
pub fn junit(report: &Report) -> Result<String, quick_junit::SerializeError> {
    let mut suites = Suites::new("volpack");
    let failed = |kind, message: &str| {
        let mut status = TestCaseStatus::non_success(kind);
        status.set_message(message);
        status
    };
    for asset in &report.assets {
        let mut suite = TestSuite::new(asset.name.as_str());
        let built = match &asset.error {
            None => TestCaseStatus::success(),
            Some(error) => failed(NonSuccessKind::Error, error),
        };
        let mut case = TestCase::new("build and verify", built);
        let seconds = asset.pack.as_ref().and_then(|pack| pack.figures.build_seconds);
        if let Some(seconds) = seconds {
            case.set_time(std::time::Duration::from_secs_f64(seconds));
        }
        suite.add_test_case(case);
        suite.add_test_cases(over(report, Some(&asset.name)));
        suites.add_test_suite(suite);
    }
    let mut suite = TestSuite::new("all assets");
    suite.add_test_cases(over(report, None));
    if suite.test_cases.is_empty() {
        suite.add_test_case(TestCase::new("budget", TestCaseStatus::success()));
    }
    suites.add_test_suite(suite);
    suites.to_string()
}

/// A failed case for each limit that an asset, or all of them, are past.
fn over(report: &Report, asset: Option<&str>) -> Vec<TestCase> {
    let case = |breach: &Breach| {
        let mut status = TestCaseStatus::non_success(NonSuccessKind::Failure);
        status.set_message(format!("{}; {}", breach.message, breach.remedy));
        TestCase::new(format!("budget {}", breach.budget), status)
    };
    report.breaches_of(asset).map(case).collect()
}
