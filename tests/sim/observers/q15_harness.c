/* Feeds sim/observers/c/vector_tracking_q15.c from standard input; built and driven by q15_harness.py.
 *
 * All int32, native byte order. In: the fields of hbq_params_t and of hbq_state_t, then a row a period: 1 where the
 * observer is initialised before it, and the fields of hbq_sample_t. Out: the fields of hbq_state_t after each period.
 * A field that does not fit into its type ends the run with status 3. With an argument N the rows are run N times and
 * the nanoseconds a step are printed on standard error.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "vector_tracking_q15.h"

enum { PARAMS = 12, STATE = 10, ROW = 10 };

static int16_t narrow(int32_t value)
{
    if (value < INT16_MIN || value > INT16_MAX) {
        fprintf(stderr, "%ld does not fit into 16 bits\n", (long)value);
        exit(3);
    }
    return (int16_t)value;
}

static uint16_t narrow_unsigned(int32_t value)
{
    if (value < 0 || value > UINT16_MAX) {
        fprintf(stderr, "%ld does not fit into 16 bits unsigned\n", (long)value);
        exit(3);
    }
    return (uint16_t)value;
}

static hbq_params_t params_of(const int32_t *v)
{
    hbq_params_t p = {narrow(v[0]), narrow(v[1]), narrow(v[2]), narrow(v[3]), v[4],          v[5],
                      v[6],         v[7],         v[8],         v[9],         narrow(v[10]), 0u};
    memcpy(&p.hall_offset, &v[11], sizeof p.hall_offset);
    return p;
}

static hbq_state_t state_of(const int32_t *v)
{
    hbq_state_t s = {narrow(v[0]), narrow(v[1]), narrow(v[2]), narrow(v[3]), narrow(v[4]), v[5], v[6], 0u, v[8], v[9]};
    memcpy(&s.theta, &v[7], sizeof s.theta);
    return s;
}

static hbq_sample_t sample_of(const int32_t *v)
{
    const hbq_sample_t x = {narrow(v[0]), narrow(v[1]), narrow(v[2]), narrow(v[3]), v[4], narrow_unsigned(v[5]),
                            narrow(v[6]), narrow(v[7]), narrow(v[8])};
    return x;
}

static void put(const hbq_state_t *s)
{
    int32_t v[STATE] = {s->primed, s->on,  s->direction, s->i_alpha, s->i_beta,
                        s->e_alpha, s->e_beta, 0,        s->corr_i,  s->omega};
    memcpy(&v[7], &s->theta, sizeof s->theta);
    fwrite(v, sizeof v, 1, stdout);
}

int main(int argc, char **argv)
{
    int32_t head[PARAMS + STATE];
    int32_t row[ROW];
    hbq_sample_t *samples = NULL;
    char *reset = NULL;
    size_t n = 0, room = 0, k;
    hbq_params_t params;
    hbq_state_t state;

    if (fread(head, sizeof head, 1, stdin) != 1) {
        return 2;
    }
    params = params_of(head);
    state = state_of(head + PARAMS);
    while (fread(row, sizeof row, 1, stdin) == 1) {
        if (n == room) {
            room = 2 * room + 1024;
            samples = realloc(samples, room * sizeof *samples);
            reset = realloc(reset, room);
            if (samples == NULL || reset == NULL) {
                return 2;
            }
        }
        reset[n] = row[0] != 0;
        samples[n] = sample_of(row + 1);
        n++;
    }
    if (argc > 1) {
        const long repeat = strtol(argv[1], NULL, 10);
        const clock_t start = clock();
        long r;
        for (r = 0; r < repeat; r++) {
            for (k = 0; k < n; k++) {
                hbq_step(&params, &state, &samples[k]);
            }
        }
        fprintf(stderr, "%.3f\n", 1e9 * (double)(clock() - start) / CLOCKS_PER_SEC / ((double)n * (double)repeat));
    } else {
        for (k = 0; k < n; k++) {
            if (reset[k]) {
                hbq_init(&state);
            }
            hbq_step(&params, &state, &samples[k]);
            put(&state);
        }
    }
    free(samples);
    free(reset);
    return 0;
}
