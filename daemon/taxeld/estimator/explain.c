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

enum { Z, LEVEL, ROOT, SILENT, SIGMA2, GAIN2, SAG, MOST };  /* of what is kept */
enum { LANES = 8 };  /* of a vector; a run is no longer */
enum { TURNS = 64 };  /* of poses, whose cosines and sines are found together */

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
    double band, hidden, robust;  /* BAND_M, HIDDEN and ROBUST */
    double least_variance, iterations;
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
    float *depth, *gx, *gy, *away, *ax, *ay;  /* of taxels near a press, one after the other, */
    float *z, *level, *root, *silent, *sigma2, *gain2;  /* and what is kept of them */
    float *rate, *most;  /* depths below which the cover's sag is read, and one sd more */
    int64_t n;
} Near;

INLINE float within(float value, float low, float high)
{
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* The taxels that a pose presses, or nearly, the sensor at (x, y) in cells and turned. */
INLINE void look_up(
    const Model *m, Near *near, const float *kept, int64_t field, float x, float y, float cosine,
    float sine, int about)
{
    const float *px = m->place, *py = px + m->runs;
    float *restrict us = near->u, *restrict vs = near->v;
    uint32_t *restrict cells = near->cell, nx = m->nx, last = (m->ny - 1) * m->nx - 2;
    float right = m->nx - 1.001, top = m->ny - 1.001, band = about ? m->band : 0.0;
    float by_depth = -1.0 / m->depth_max, by_cell = by_depth / m->cell;
    float *restrict depth = near->depth, *restrict gx = near->gx, *restrict gy = near->gy;
    float *restrict z = near->z, *restrict level = near->level;
    float *restrict root = near->root, *restrict silent = near->silent;
    float *restrict sigma2 = near->sigma2, *restrict gain2 = near->gain2;
    float *restrict rate = near->rate, *restrict most = near->most;
    float *restrict tx = near->tx, *restrict ty = near->ty, least = m->least_rate;
    const uint8_t *mask = about ? m->about : m->pressed;
    int64_t n = 0, up = m->nx * m->heights, across = m->heights;
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
        if (cells[i] > last || !mask[cells[i]])  /* beyond: of a pose that is not a number */
            continue;
        const float *at = m->distance + cells[i] * m->heights + m->height[i];
        const float *read = kept + m->first[i];
        float u = us[i], v = vs[i];
        Vector front = READ(at), back = READ(at + up);
        Vector below = READ(at + across) - front, above = READ(at + up + across) - back;
        Vector low = front + below * u, rise = back + above * u - low;
        Vector distance = low + rise * v;
        /* lanes beyond the run's end are written over by the next one */
        VECTOR(depth + n) = distance * by_depth;
        Vector sx = (below + (above - below) * v) * by_cell, sy = rise * by_cell;
        Vector along = ABSOLUTE(sx * tx[i] + sy * ty[i]);
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
    float below = within(depth / rate - 1.0f, -farthest, 0.0f);
    return depth < rate ? rate * expf(below) : depth;
}

/* `Readings.offset` of offsets.py: moves the depths to where the offset explains the readings best;
   what the integral over it adds. */
INLINE double offset(const Model *m, Near *near, double variance)
{
    double precision = 1.0 / (variance > m->least_variance ? variance : m->least_variance);
    double x = 0.0, y = 0.0, det = precision * precision;
    float robust = m->robust, farthest = m->farthest_rates, least = m->least_rate;
    float *restrict away = near->away, *restrict ax = near->ax, *restrict ay = near->ay;
    const float *restrict rate = near->rate;
    float *restrict depth = near->depth;
    const float *restrict gx = near->gx, *restrict gy = near->gy;
    const float *restrict level = near->level, *restrict root = near->root, *restrict z = near->z;
    int64_t n = near->n;
    for (int iteration = 0; iteration < (int)m->iterations; iteration++) {
        float xx = 0, xy = 0, yy = 0, bx = 0, by = 0, ex = x, ey = y;
        for (int64_t i = 0; i < n; i++) {
            float at = depth[i] + gx[i] * ex + gy[i] * ey;
            int sags = (rate[i] > least) & (at < rate[i]);  /* else a straight line */
            float read = sags ? sagging(at, rate[i], farthest) : at;
            float move = (sags ? read / rate[i] : 1.0f) * root[i];
            away[i] = (level[i] - read) * root[i];
            ax[i] = gx[i] * move;
            ay[i] = gy[i] * move;
        }
        for (int64_t i = 0; i < n; i++) {
            float off = away[i];
            off = z[i] < 1.0f || off > 0.0f ? off : 0.0f;  /* LOW and HIGH */
            off = z[i] > 0.0f || off < 0.0f ? off : 0.0f;
            float size = fabsf(off);
            float weight = off == 0.0f ? 0.0f : robust / (size > robust ? size : robust);
            xx += weight * ax[i] * ax[i];
            xy += weight * ax[i] * ay[i];
            yy += weight * ay[i] * ay[i];
            bx += weight * ax[i] * off;
            by += weight * ay[i] * off;
        }
        double hxx = xx + precision, hyy = yy + precision, hxy = xy;
        double rx = bx - precision * x, ry = by - precision * y;
        det = hxx * hyy - hxy * hxy;
        x += (hyy * rx - hxy * ry) / det;
        y += (hxx * ry - hxy * rx) / det;
    }
    float ex = x, ey = y;
    for (int64_t i = 0; i < n; i++)
        depth[i] += gx[i] * ex + gy[i] * ey;
    return -0.5 * ((x * x + y * y) * precision + log(det / (precision * precision)));
}

/* By how much readings are likelier at these depths, less `hidden`, than of taxels that are not
   pressed: `Noise.log_density`. Of a silent scan, whose depths may be less by `hidden`, presses
   alone count. */
INLINE double gain(const Model *m, const Near *near, float hidden, int sags)
{
    float farthest = m->farthest, beneath = m->farthest_rates;
    float b1 = m->bowling1, b3 = m->bowling3, keep = 1.0 - m->outliers, least = m->least;
    float sum = 0.0f;
    const float *restrict depth = near->depth, *restrict rate = near->rate;
    const float *restrict z = near->z, *restrict level = near->level, *restrict most = near->most;
    const float *restrict sigma2 = near->sigma2, *restrict gain2 = near->gain2;
    const float *restrict silent = near->silent, *restrict root = near->root;
    for (int64_t i = 0; i < near->n; i++) {
        float h = within(depth[i] - hidden, 0.0f, 1.0f), more = 0.0f;
        if (sags) {
            h = within(sagging(depth[i], rate[i], beneath), 0.0f, 1.0f);
            more = within(sagging(depth[i], most[i], beneath), 0.0f, 1.0f) - h;
        }
        float variance = sigma2[i] + gain2[i] * h * h + more * more;
        float off = within((level[i] - h) / sqrtf(variance), -farthest, farthest);
        float square = off * off, beyond = (z[i] > 0.0f ? off : -off) * (b1 + b3 * square);
        int is_told = (z[i] > 0.0f) & (z[i] < 1.0f);
        float power = expf(is_told ? -0.5f * square : beyond);
        float likely = is_told ? power / sqrtf(6.2831853f * variance) : 1.0f / (1.0f + power);
        float gained = logf(keep * likely + least) - silent[i];
        sum += root[i] > 0.0f ? gained : 0.0f;
    }
    return sum;
}

/* Room for `near`, of zeros; NULL where there is no memory left. */
static void *room_for(const Model *m, const Scans *s, Near *near)
{
    float **each[] = {&near->depth, &near->gx, &near->gy, &near->away, &near->ax, &near->ay,
                      &near->z, &near->level, &near->root, &near->silent, &near->sigma2,
                      &near->gain2, &near->rate, &near->most};
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
    double cosine = turned[0] * c + turned[1] * sn, sine = turned[1] * c - turned[0] * sn;
    double x = (c * dx + sn * dy - m->x) / m->cell, y = (c * dy - sn * dx - m->y) / m->cell;
    uint32_t column = (int32_t)within(x, 0.0f, m->nx - 1.001);
    uint32_t row = (int32_t)within(y, 0.0f, m->ny - 1.001);
    if (column >= m->nx - 1 || row >= m->ny - 1 || !m->reach[row * m->nx + column])
        return 0.0;
    int about = !s->silent[k];
    double variance = s->variance[k];
    look_up(m, near, s->kept + k * m->taxels, s->scans * m->taxels, x, y, cosine / m->cell,
            sine / m->cell, about);
    if (!near->n)
        return 0.0;
    if (!about)
        return gain(m, near, m->hidden / m->depth_max * sqrt(variance), 0);
    double added = offset(m, near, variance);
    return added + gain(m, near, 0.0f, 1);
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
    double turn[TURNS] = {0}, cosine[TURNS], sine[TURNS];
    for (int64_t i = 0; i < n; i++) {
        if (i % TURNS == 0) {
            for (int64_t j = 0; j < TURNS && i + j < n; j++)
                turn[j] = poses[3 * (i + j) + 2];
            for (int64_t j = 0; j < TURNS; j++)  /* two loops: one would be no vector's */
                cosine[j] = cos(turn[j]);
            for (int64_t j = 0; j < TURNS; j++)
                sine[j] = sin(turn[j]);
        }
        const double *pose = poses + 3 * i;
        double c = cosine[i % TURNS], sn = sine[i % TURNS];
        for (int64_t k = 0; k < s->scans; k++)
            out[i * s->scans + k] = explained(m, s, &near, k, pose, c, sn);
    }
    free(room);
    return 0;
}
