/* How well poses explain remembered scans: `Memory.explain` of memory.py, pose by pose, without the
   arrays that numpy makes on the way. Any change here is a change there; tests hold both equal.
   Built with -ffast-math: nothing in here is infinite or not a number. Loops over the taxels near a
   press run over whole vectors, the last one filled up with taxels that tell nothing.

   Taxels come in runs: those of one place whose slices follow each other, so that one vector looks
   all of them up. compiled.py makes the runs, and lays readings out in their order. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

/* SHA-256 of this file, as it was built */
const char taxeld_source[] = SOURCE;

#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define FASTEST __attribute__((target_clones("avx2", "default")))  /* by the processor */
#else
#define FASTEST
#endif
#define INLINE static inline __attribute__((always_inline))  /* into each of the clones */

enum { Z, LEVEL, ROOT, SILENT, SIGMA2, GAIN2, SAG, MOST, QUIET };  /* of what is kept */
enum { LANES = 8 };  /* of a vector; a run is no longer */

typedef float Vector __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int32_t Mask __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
#define VECTOR(at) (*(Vector *)(at))
#define READ(at) (*(const Vector *)(at))
#define ABSOLUTE(vector) ((Vector)((Mask)(vector) & 0x7fffffff))

typedef struct {
    const float *distance;  /* (ny, nx, heights) signed distances [m]; LANES may be read beyond */
    const uint8_t *pressed, *about, *reach;  /* (ny, nx) cells that count, of a taxel or an axis */
    const float *place;  /* (2, runs) x, y [m] */
    const int64_t *first, *height, *size;  /* (runs,) the run's first taxel, its slice, how many */
    int64_t nx, ny, heights, runs, taxels;
    double x, y, cell, depth_max;  /* of the grid's origin, of its cells, of full scale [m] */
    double band, far, hidden, robust, clear;  /* BAND_M, and of likelihood.py, as are */
    double steps, enough, most, least_m2;
    double outliers, least, farthest, bowling1, bowling3;  /* of `Noise` */
    double least_rate, farthest_rates;  /* LEAST_RATE and FARTHEST_RATES of response.py */
} Model;

typedef struct {
    const float *kept;  /* (fields, scans, taxels) in order of the runs; LANES may be read beyond */
    const double *sensor;  /* (scans, 3) */
    const double *variance;  /* (scans,) of each one's offset [m^2] */
    const uint8_t *silent;  /* (scans,) */
    int64_t scans;
} Scans;

typedef struct {  /* room, for one pose and scan but where it says more */
    double *turned;  /* (scans, 2) cosine and sine of the sensor's turn */
    float *u, *v;  /* (runs,) where runs are in their cells */
    float *tx, *ty;  /* (runs,) direction around the link there */
    uint32_t *cell;  /* (runs,) */
    float *depth, *gx, *gy, *off, *ax, *ay;  /* of taxels near a press, one after the other, */
    float *z, *level, *root, *silent, *sigma2, *gain2, *quiet;  /* and what is kept of them */
    float *rate, *most;  /* depths below which the cover's sag is read, and one sd more */
    int64_t n;
} Near;

typedef struct {  /* a scan, and the sensor in the object's frame, in cells */
    const float *kept;
    double x, y, cosine, sine, variance;
    int64_t field;  /* from each field to the next */
    int touched;
} Seen;

typedef struct {  /* `Fit` of likelihood.py, at an offset of (ex, ey) m */
    double ex, ey, log_p, x, y, xx, xy, yy;
} Fit;

INLINE float within(float value, float low, float high)
{
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* The taxels nearer than `band` to a press, the sensor at (x, y) in cells. Of a silent scan, whose
   depths may be less by its offset, presses alone count, without sag. */
INLINE void look_up(const Model *m, Near *near, const Seen *s, float x, float y, float band)
{
    float cosine = s->cosine, sine = s->sine, sags = s->touched;
    float hidden = s->touched ? 0.0 : m->hidden * sqrt(s->variance);
    const float *px = m->place, *py = px + m->runs;
    float *restrict us = near->u, *restrict vs = near->v;
    uint32_t *restrict cells = near->cell, nx = m->nx, last = (m->ny - 1) * m->nx - 2;
    float right = m->nx - 1.001, top = m->ny - 1.001;
    float by_depth = -1.0 / m->depth_max, by_cell = by_depth / m->cell;
    float *restrict depth = near->depth, *restrict gx = near->gx, *restrict gy = near->gy;
    float *restrict z = near->z, *restrict level = near->level, *restrict root = near->root;
    float *restrict silent = near->silent, *restrict sigma2 = near->sigma2;
    float *restrict gain2 = near->gain2, *restrict quiet = near->quiet;
    float *restrict rate = near->rate, *restrict most = near->most;
    float *restrict tx = near->tx, *restrict ty = near->ty, least = m->least_rate;
    const uint8_t *mask = s->touched ? m->about : m->pressed;
    int beyond = band > (float)m->band;  /* which the mask does not hold */
    int64_t n = 0, up = m->nx * m->heights, across = m->heights, field = s->field;
    for (int64_t i = 0; i < m->runs; i++) {
        float u = within(cosine * px[i] - sine * py[i] + x, 0.0f, right);
        float v = within(sine * px[i] + cosine * py[i] + y, 0.0f, top);
        int32_t column = (int32_t)u, row = (int32_t)v;
        float ux = u - x, uy = v - y, by_length = 1.0f / sqrtf(ux * ux + uy * uy);
        tx[i] = -uy * by_length;
        ty[i] = ux * by_length;
        us[i] = u - column;
        vs[i] = v - row;
        cells[i] = (uint32_t)row * nx + (uint32_t)column;
    }
    for (int64_t i = 0; i < m->runs; i++) {
        if (cells[i] > last || !(beyond | mask[cells[i]]))  /* first: a pose that is no number */
            continue;
        const float *at = m->distance + cells[i] * m->heights + m->height[i];
        const float *read = s->kept + m->first[i];
        float u = us[i], v = vs[i];
        Vector front = READ(at), back = READ(at + up);
        Vector below = READ(at + across) - front, above = READ(at + up + across) - back;
        Vector low = front + below * u, rise = back + above * u - low;
        Vector distance = low + rise * v;
        /* lanes beyond the run's end are written over by the next one */
        VECTOR(depth + n) = (distance + hidden) * by_depth;
        Vector sx = (below + (above - below) * v) * by_cell, sy = rise * by_cell;
        Vector along = sags * ABSOLUTE(sx * tx[i] + sy * ty[i]);
        VECTOR(gx + n) = sx;
        VECTOR(gy + n) = sy;
        VECTOR(rate + n) = along * READ(read + SAG * field);
        VECTOR(most + n) = along * READ(read + MOST * field);
        VECTOR(root + n) = (Vector)((Mask)READ(read + ROOT * field) & (Mask)(distance < band));
        VECTOR(z + n) = READ(read + Z * field);
        VECTOR(level + n) = READ(read + LEVEL * field);
        VECTOR(sigma2 + n) = READ(read + SIGMA2 * field);
        VECTOR(gain2 + n) = READ(read + GAIN2 * field);
        VECTOR(silent + n) = READ(read + SILENT * field);
        VECTOR(quiet + n) = READ(read + QUIET * field);
        n += m->size[i];
    }
    VECTOR(root + n) = (Vector){0};  /* what fills up the last vector is not believed */
    VECTOR(sigma2 + n) = (Vector){0} + 1.0f;
    near->n = (n + LANES - 1) / LANES * LANES;
    for (int64_t i = 0; i < near->n; i++) {
        rate[i] = rate[i] > least ? rate[i] : least;
        most[i] = most[i] > least ? most[i] : least;
    }
}

/* `sagging` of response.py */
INLINE float sagging(float depth, float rate, float farthest)
{
    float sag = rate * expf(within(depth / rate - 1.0f, -farthest, 0.0f));
    return sag > depth ? sag : depth;
}

/* `Touches.fit` of likelihood.py. Its loops are two, and no vectors may overlap, as checks of that
   would be too many. */
INLINE Fit fit(const Model *m, Near *near, const Seen *s, double ex, double ey, int first)
{
    double far = first ? m->far * sqrt(s->variance) : 0.0, band = far > m->band ? far : m->band;
    double precision = 1.0 / (s->variance > m->least_m2 ? s->variance : m->least_m2);
    look_up(m, near, s, s->x + ex / m->cell, s->y + ey / m->cell, s->touched ? band : 0.0);
    float farthest = m->farthest, beneath = m->farthest_rates, robust = m->robust;
    float b1 = m->bowling1, b3 = m->bowling3, keep = 1.0 - m->outliers, least = m->least;
    float least_rate = m->least_rate, clear = first ? m->clear * m->clear : 1e30;
    float sum = 0, xx = 0, xy = 0, yy = 0, bx = 0, by = 0;
    float *restrict offs = near->off, *restrict ax = near->ax, *restrict ay = near->ay;
    const float *depth = near->depth, *rate = near->rate, *most = near->most;
    const float *z = near->z, *level = near->level, *root = near->root, *silent = near->silent;
    const float *sigma2 = near->sigma2, *gain2 = near->gain2, *quiet = near->quiet;
    const float *slow = first ? most : rate;
#pragma GCC ivdep
    for (int64_t i = 0; i < near->n; i++) {
        float low = sagging(depth[i], rate[i], beneath), high = sagging(depth[i], most[i], beneath);
        float h = within(low, 0.0f, 1.0f), more = within(high, 0.0f, 1.0f) - h;
        float variance = sigma2[i] + gain2[i] * h * h + more * more;
        float by_sd = 1.0f / sqrtf(variance);
        float off = within((level[i] - h) * by_sd, -farthest, farthest), square = off * off;
        float beyond = (z[i] > 0.0f ? off : -off) * (b1 + b3 * square);
        int is_told = (z[i] > 0.0f) & (z[i] < 1.0f);
        float power = expf(is_told ? -0.5f * square : beyond);
        float likely = is_told ? 0.39894228f * power * by_sd : 1.0f / (1.0f + power);
        likely = (1.0f - quiet[i]) * (keep * likely + least);
        float gained = logf(quiet[i] + likely) - silent[i];
        sum += root[i] > 0.0f ? gained : 0.0f;
        by_sd *= sqrtf(likely / (quiet[i] + likely));
        float sag = first ? high : low;
        int straight = (slow[i] <= least_rate) | (depth[i] >= slow[i]);
        straight |= z[i] * z[i] > clear * sigma2[i];
        float move = straight ? by_sd : sag / slow[i] * by_sd;
        offs[i] = (level[i] - (straight ? depth[i] : sag)) * by_sd;
        ax[i] = near->gx[i] * move;
        ay[i] = near->gy[i] * move;
    }
    for (int64_t i = 0; i < near->n; i++) {
        float off = offs[i];
        off = z[i] < 1.0f || off > 0.0f ? off : 0.0f;
        off = z[i] > 0.0f || off < 0.0f ? off : 0.0f;
        float size = fabsf(off), weight = robust / (size > robust ? size : robust);
        weight = root[i] > 0.0f && off != 0.0f ? weight : 0.0f;
        bx += weight * ax[i] * off;
        by += weight * ay[i] * off;
        xx += weight * ax[i] * ax[i];
        xy += weight * ax[i] * ay[i];
        yy += weight * ay[i] * ay[i];
    }
    return (Fit){
        ex, ey, sum - 0.5 * precision * (ex * ex + ey * ey), bx - precision * ex,
        by - precision * ey, xx + precision, xy, yy + precision};
}

/* `_laplace` of likelihood.py across (nx, ny); the step from there. */
INLINE double laplace(const Model *m, Fit f, double nx, double ny, double *step)
{
    double curve = nx * nx * f.xx + 2.0 * nx * ny * f.xy + ny * ny * f.yy;
    *step = (nx * f.x + ny * f.y) / curve;
    double more = 0.5 * curve * *step * *step;
    if (more < m->enough)
        *step = 0.0;
    return f.log_p + (more < m->most ? more : m->most) - 0.5 * log(curve);
}

/* `Touches.log_p` of likelihood.py */
INLINE double over_offsets(const Model *m, Near *near, const Seen *s, Fit f)
{
    Fit top = f;
    for (int i = 0; i < (int)m->steps; i++) {
        double det = f.xx * f.yy - f.xy * f.xy;
        double dx = (f.yy * f.x - f.xy * f.y) / det, dy = (f.xx * f.y - f.xy * f.x) / det;
        if (0.5 * (dx * f.x + dy * f.y) < m->enough)
            break;
        f = fit(m, near, s, f.ex + dx, f.ey + dy, 0);
        if (f.log_p > top.log_p)
            top = f;
    }
    double turn = 0.5 * atan2(2.0 * top.xy, top.xx - top.yy), nx = cos(turn), ny = sin(turn);
    double steep = nx * nx * top.xx + 2.0 * nx * ny * top.xy + ny * ny * top.yy;
    double width = sqrt(steep / (top.xx * top.yy - top.xy * top.xy)), step;
    double node[3] = {laplace(m, top, nx, ny, &step)}, most = node[0];
    for (int i = 1; i < 3; i++) {
        double way = (i == 1 ? 1.0 : -1.0) * sqrt(2.0) * width;  /* NODE */
        f = fit(m, near, s, top.ex - way * ny, top.ey + way * nx, 0);
        node[i] = laplace(m, f, nx, ny, &step);
        if (step != 0.0) {
            f = fit(m, near, s, f.ex + step * nx, f.ey + step * ny, 0);
            double again = laplace(m, f, nx, ny, &step);
            node[i] = again > node[i] ? again : node[i];
        }
        most = node[i] > most ? node[i] : most;
    }
    double beside = exp(node[1] - most) + exp(node[2] - most);
    double sum = 0.5 * exp(node[0] - most) + 0.25 * exp(1.0) * beside;  /* by NODE */
    return most + log(sum * width / s->variance);
}

/* Room for `near`, of zeros; NULL where there is no memory left. */
static void *room_for(const Model *m, const Scans *s, Near *near)
{
    float **each[] = {&near->depth, &near->gx, &near->gy, &near->off, &near->ax, &near->ay,
                      &near->z, &near->level, &near->root, &near->silent, &near->sigma2,
                      &near->gain2, &near->quiet, &near->rate, &near->most};
    int64_t fields = sizeof(each) / sizeof(*each), runs = m->runs, taxels = m->taxels + LANES;
    int64_t turned = 2 * s->scans * sizeof(double);
    double *room = calloc(1, turned + (5 * runs + fields * taxels) * sizeof(float));
    if (!room)
        return NULL;
    float *at = (float *)(room + 2 * s->scans);
    near->turned = room;
    near->u = at;
    near->v = at + runs;
    near->tx = at + 2 * runs;
    near->ty = at + 3 * runs;
    near->cell = (uint32_t *)(at + 4 * runs);
    for (int k = 0; k < fields; k++)
        *each[k] = at + 5 * runs + k * taxels;
    return room;
}

/* By how much a scan is likelier than of a skin which is not pressed, of a pose (3,) whose turn has
   this cosine and sine. */
INLINE double explained(
    const Model *m, const Scans *s, Near *near, int64_t k, const double *pose, double c, double sn)
{
    const double *sensor = s->sensor + 3 * k, *turned = near->turned + 2 * k;
    double dx = sensor[0] - pose[0], dy = sensor[1] - pose[1];
    Seen seen = {
        .kept = s->kept + k * m->taxels,
        .field = s->scans * m->taxels,
        .x = (c * dx + sn * dy - m->x) / m->cell,
        .y = (c * dy - sn * dx - m->y) / m->cell,
        .cosine = (turned[0] * c + turned[1] * sn) / m->cell,
        .sine = (turned[1] * c - turned[0] * sn) / m->cell,
        .variance = s->variance[k],
        .touched = !s->silent[k],
    };
    uint32_t column = (int32_t)within(seen.x, 0.0f, m->nx - 1.001);
    uint32_t row = (int32_t)within(seen.y, 0.0f, m->ny - 1.001);
    int far = seen.touched && m->far * sqrt(seen.variance) > m->band;
    if (column >= m->nx - 1 || row >= m->ny - 1 || !(far | m->reach[row * m->nx + column]))
        return 0.0;
    Fit f = fit(m, near, &seen, 0.0, 0.0, 1);
    int offsets = seen.touched && seen.variance > m->least_m2;
    return offsets ? over_offsets(m, near, &seen, f) : f.log_p;
}

/* log p(scan | pose) beyond that of a skin which is not pressed, of poses (n, 3): out (n, scans).
   0, or -1 where there is no memory left. */
FASTEST int taxeld_explain(
    const Model *m, const Scans *s, const double *poses, int64_t n, double *out)
{
    Near near;
    void *room = room_for(m, s, &near);
    if (!room)
        return -1;
    for (int64_t k = 0; k < s->scans; k++) {
        near.turned[2 * k] = cos(s->sensor[3 * k + 2]);
        near.turned[2 * k + 1] = sin(s->sensor[3 * k + 2]);
    }
    for (int64_t i = 0; i < n; i++) {
        double c = cos(poses[3 * i + 2]), sn = sin(poses[3 * i + 2]);
        for (int64_t k = 0; k < s->scans; k++)
            out[i * s->scans + k] = explained(m, s, &near, k, poses + 3 * i, c, sn);
    }
    free(room);
    return 0;
}
