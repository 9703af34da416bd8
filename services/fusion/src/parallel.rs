//! A map that works on several items at once and keeps their order.

/// Results of `work` for each of `items`, in their order, on up to `threads` threads. The results
/// do not depend on that number.
pub(crate) fn map<T: Sync, R: Send>(
    items: &[T],
    threads: usize,
    work: impl Fn(&T) -> R + Sync,
) -> Vec<R> {
    let threads = threads.clamp(1, items.len().max(1));
    if threads == 1 {
        return items.iter().map(work).collect();
    }
    let work = &work;
    std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads)
            .map(|first| {
                let own = items.iter().skip(first).step_by(threads);
                scope.spawn(move || own.map(work).collect::<Vec<R>>())
            })
            .collect();
        let first = items.iter().step_by(threads).map(work).collect::<Vec<R>>();
        let mut shares = vec![first.into_iter()];
        for other in others {
            match other.join() {
                Ok(share) => shares.push(share.into_iter()),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        (0..items.len()).filter_map(|place| shares[place % threads].next()).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_is_kept_whatever_the_threads() {
        let items: Vec<usize> = (0..10).collect();
        for threads in 0..15 {
            for many in 0..items.len() {
                let squares: Vec<usize> = items[..many].iter().map(|item| item * item).collect();
                assert_eq!(map(&items[..many], threads, |item| item * item), squares);
            }
        }
    }

    #[test]
    fn a_panic_is_passed_on() {
        let sure = std::panic::catch_unwind(|| map(&[1, 2, 3], 3, |item| assert_ne!(*item, 2)));
        assert!(sure.is_err());
    }
}
